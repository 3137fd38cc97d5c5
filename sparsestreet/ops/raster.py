"""What a backend hands to the op before a background is put behind it, or raises."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


class PairLimitError(RuntimeError):
    """The splats of one view cover more (splat, tile) pairs than may be held in memory."""

    @staticmethod
    def of(pairs: int, limit: int, worst: list[tuple[int, int]]) -> "PairLimitError":
        """The error for ``pairs`` of at most ``limit``; ``worst``: rows with most tiles, and how many."""
        named = ", ".join(f"row {row} ({tiles})" for row, tiles in worst)
        return PairLimitError(
            f"the splats cover {pairs} tiles, more than the {limit} that may be held; most: {named}. "
            "Prune or shrink those rows, or render a smaller image"
        )


@dataclass(frozen=True)
class Raster:
    """Blended layers of one view, all differentiable except ``radii``."""

    rgb: Float[Tensor, "h w 3"]
    """Sum over splats of weight times color (premultiplied: no background)."""
    transmittance: Float[Tensor, "h w"]
    """Light that gets past all splats, kept itself: 1 - alpha would lose its digits in opaque pixels."""
    depth_sum: Float[Tensor, "h w"]
    """Sum over splats of weight times depth, meters."""
    radii: Float[Tensor, " n"]
    """Half the longer side of the opacity-aware box, pixels; 0 where the row was culled."""
