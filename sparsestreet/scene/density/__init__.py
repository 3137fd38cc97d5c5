"""Density control: strategies that decide where a node needs more or fewer Gaussians, and return a RowPlan.

``strategy`` is the interface, and accumulates screen gradients and sizes since the last refinement.
``gradient`` is the strategy of 3DGS, ``vibrating`` that of PVG, ``mcmc`` that of 3DGS-MCMC.
"""

from sparsestreet.scene.density.gradient import GradientDensity, outside_boxes
from sparsestreet.scene.density.mcmc import McmcDensity
from sparsestreet.scene.density.strategy import DensityStatistics, DensityStrategy
from sparsestreet.scene.density.vibrating import VibratingDensity

__all__ = [
    "DensityStatistics",
    "DensityStrategy",
    "GradientDensity",
    "McmcDensity",
    "VibratingDensity",
    "outside_boxes",
]
