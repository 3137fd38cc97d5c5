"""The reference for the fast backends: dense plain torch with autograd, float32 or float64."""

from sparsestreet.ops.reference.blend import contribution, leave_one_out, median_depth, rasterize
from sparsestreet.ops.reference.projection import Splats, on_screen, visible_rows

__all__ = ["Splats", "contribution", "leave_one_out", "median_depth", "on_screen", "rasterize", "visible_rows"]
