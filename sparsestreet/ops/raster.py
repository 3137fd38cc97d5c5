"""What a backend hands to the op before a background is put behind it."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Raster:
    """Blended layers of one view, all differentiable except ``radii``."""

    rgb: Float[Tensor, "h w 3"]
    """Sum over splats of weight times colour (premultiplied: no background)."""
    transmittance: Float[Tensor, "h w"]
    """Light that gets past all splats, kept itself: 1 - alpha would lose its digits in opaque pixels."""
    depth_sum: Float[Tensor, "h w"]
    """Sum over splats of weight times depth, metres."""
    radii: Float[Tensor, " n"]
    """Half the longer side of the opacity-aware box, pixels; 0 where the row was culled."""
