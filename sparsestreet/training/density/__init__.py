"""Where a scene needs more Gaussians and where fewer: statistics, and the pure functions that decide."""

from sparsestreet.training.density.gradient import GradientDensity, cull, densify, outside_boxes, reset_opacity
from sparsestreet.training.density.statistics import DensityStatistics

__all__ = ["DensityStatistics", "GradientDensity", "cull", "densify", "outside_boxes", "reset_opacity"]
