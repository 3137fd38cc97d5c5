"""What a backend returns to the op, before the background is added, what it gathers beside gradients, or raises."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.demand import DemandError
from sparsestreet.types import LeaveOneOut

MIN_ALPHA = 1e-6
"""Depth is divided by alpha, or by this where a pixel is emptier."""


class PairLimitError(DemandError):
    """The splats of one view cover more (splat, tile) pairs than memory may hold.

    >>> raise PairLimitError.of(pairs=900, limit=800, worst=[(4, 600)])
    Traceback (most recent call last):
    sparsestreet.ops.raster.PairLimitError: the splats cover 900 tiles, more than the 800 that may be held; most: ...
    """

    @staticmethod
    def of(pairs: int, limit: int, worst: list[tuple[int, int]]) -> "PairLimitError":
        """Return the error for ``pairs`` above ``limit``; ``worst``: the rows with most tiles, and their numbers."""
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
    """Light that passes all splats. It is stored because 1 - alpha would lose its digits in opaque pixels."""
    depth_sum: Float[Tensor, "h w"]
    """Sum over splats of weight times depth, meters."""
    radii: Float[Tensor, " n"]
    """Half the longer side of the opacity-aware box, pixels; 0 for a culled row."""


SHAPE = 4
"""Number of the fields of ``Gaussians.learned`` before the tables of harmonics."""


def empty_gradients(fields: Sequence[Tensor], terms: int | None, asked: Sequence[bool]) -> list[Tensor | None]:
    """Unwritten gradients of ``Gaussians.learned``. As in torch, coefficients behind the first have none where no
    gradient is asked for, or none of them is in use: an optimizer then skips them."""
    rests = len(fields) if terms is None else SHAPE + (len(fields) - SHAPE) // 2
    return [
        torch.empty_like(field) if place < rests or (asked[place] and min(terms or 1, 1 + field.shape[1]) > 1) else None
        for place, field in enumerate(fields)
    ]


COUNTINGS = 3
"""In how many ways squared changes are counted in one backward pass."""


@dataclass
class LeaveOneOutSums:
    """What the backward pass of a view finds out beside its gradients: how far the view changes without each row.

    The same as ``leave_one_out`` says, but lists and image of the rendering are there already: that leaves one loop
    over the pixels.

    >>> LeaveOneOutSums(torch.ones(3, 4, 6)).found is None  # until splat(..., changes=...) and its backward pass
    True
    """

    pixel_weights: Float[Tensor, "3 h w"]
    """How much the squared change of each pixel counts, in three ways."""
    background: Float[Tensor, "h w 3"] | None = None
    """Light behind the splats; None: black."""
    found: LeaveOneOut | None = None
    """None until the backward pass has run."""
