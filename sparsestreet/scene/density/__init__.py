"""Where a node needs more Gaussians and where fewer: strategies of a node, pure functions that answer with a RowPlan.

``strategy`` is what each of them answers; ``statistics`` what the Gaussians did on screen since the last refinement;
``gradient`` the strategy of 3DGS, ``vibrating`` that of PVG.
"""

from sparsestreet.scene.density.gradient import GradientDensity, outside_boxes
from sparsestreet.scene.density.statistics import DensityStatistics
from sparsestreet.scene.density.strategy import DensityStrategy
from sparsestreet.scene.density.vibrating import VibratingDensity

__all__ = ["DensityStatistics", "DensityStrategy", "GradientDensity", "VibratingDensity", "outside_boxes"]
