"""Rows of Gaussian parameters, and the one way to add, drop and replace them."""

from sparsestreet.scene.gaussians.plan import RowPlan
from sparsestreet.scene.gaussians.rows import Rows

__all__ = ["RowPlan", "Rows"]
