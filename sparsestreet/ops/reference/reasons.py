"""The reasons why a row is not drawn, in order."""

from enum import IntEnum

import torch
from jaxtyping import Bool, Int
from torch import Tensor


class Reason(IntEnum):
    """Reasons in the order in which the projection checks them; the first that holds counts."""

    DRAWN = 0
    MASKED = 1
    """Opacity 0."""
    NEAR = 2
    """At the near plane, nearer, or behind the camera."""
    PAST_FOLD = 3
    """Farther off the axis than the lens polynomial describes."""
    OUTRUNS_SHUTTER = 4
    """Moves over the image nearly as fast as the image is read, in the same direction."""
    VANISHED = 5
    """Thinner than the dtype can invert, which happens only without blur."""
    OVERFLOWED = 6
    """Larger on the screen, or farther away, than the dtype can square."""
    FAINT = 7
    """Peak alpha below the cut-off."""
    OUTSIDE = 8
    """The box holds no pixel center of the image."""


def first_reason(holds: dict[Reason, Bool[Tensor, " v"]]) -> Int[Tensor, " v"]:
    """The first reason that holds for each row, DRAWN if none does; at least one reason must be given."""
    reasons = torch.zeros_like(next(iter(holds.values())), dtype=torch.int64)
    for reason in sorted(holds, reverse=True):
        reasons[holds[reason]] = reason
    return reasons
