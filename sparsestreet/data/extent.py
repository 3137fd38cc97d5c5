"""Whether all of a log lies within one scene."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.problems import Problem

LARGEST_SCENE = 20_000.0
"""Meters. Re-centered coordinates of up to this are exact to 1 mm in float32 (spacing 2^-9 m beyond 16 km, rounded)."""


def check_extent(placed: Sequence[tuple[Path, Float64[Tensor, "3"]]]) -> list[Problem]:
    """A problem where positions of poses and boxes, in one world, lie too far apart; it names the file of the farthest.

    Args:
        placed: the file that each position is from, and the position, meters.
    """
    if not placed:
        return []
    positions = torch.stack([position for _, position in placed])
    extent = float((positions.amax(0) - positions.amin(0)).max())
    if extent <= LARGEST_SCENE:
        return []
    strayed = int((positions - positions.median(0).values).norm(dim=-1).argmax())
    message = f"poses span {extent / 1000:.1f} km, more than the {LARGEST_SCENE / 1000:g} km that float32 can hold"
    remedy = "repair this pose, the farthest from the others, or read fewer frames (data.log.first_frame, .last_frame)"
    return [Problem(placed[strayed][0], message, remedy)]
