"""Tables of Gaussian parameters, and the only way to add, drop and replace their rows."""

from sparsestreet.scene.gaussians.plan import RowPlan
from sparsestreet.scene.gaussians.rows import Rows, drop_parameter
from sparsestreet.scene.gaussians.selection import InstanceFloors, Selection, keep_best

__all__ = ["InstanceFloors", "RowPlan", "Rows", "Selection", "drop_parameter", "keep_best"]
