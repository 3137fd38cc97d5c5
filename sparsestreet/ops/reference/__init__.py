"""The truth the fast backends are held to: dense plain torch with autograd, float32 or float64."""

from sparsestreet.ops.reference.blend import contribution, rasterise
from sparsestreet.ops.reference.projection import Splats, on_screen, visible_rows

__all__ = ["Splats", "contribution", "on_screen", "rasterise", "visible_rows"]
