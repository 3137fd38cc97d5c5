"""How much annotated boxes tremble about a smooth path."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.types import Track

ORDERS = 2, 3, 4
"""Of the differences: those of errors are equally large at all orders, those of motion are smaller at higher ones."""
FEWEST = 20
"""Differences of the highest order; fewer say nothing."""
_DEVIATION_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class BoxJitter:
    """Errors of boxes that change from one box to the next. Errors that stay look like another path."""

    value: float
    """Standard deviation of a corner about its path, meters, over the three axes together."""
    error: float
    """Standard error, by objects; NaN of a single one."""
    boxes: int
    by_track: tuple[float, ...]
    """The value of each object that has enough boxes, meters."""


def box_jitter(tracks: Sequence[Track], held_out: frozenset[int]) -> BoxJitter | None:
    """Measures how far corners lie from the paths through their neighbors; None where too few boxes follow each other.

    With differences of order k, over sqrt((2k)! / k!^2), independent errors keep their size. A car that accelerates has
    none of order 3, and at 2 frames a second its jerk has few of order 4. The least of the orders is taken, and of each
    the median, which leaves out strays. ``held_out`` are frames whose boxes are not looked at.
    """
    found = [_differences(track, held_out) for track in tracks]
    found = [each for each in found if len(each[-1])]
    if not found or sum(each[-1].numel() for each in found) < 3 * 8 * FEWEST:
        return None
    without = torch.tensor(
        [_size([*found[:left], *found[left + 1 :]]) for left in range(len(found) * (len(found) > 1))]
    )
    spread = (without - without.mean()).square().sum() * (len(found) - 1) / len(found)
    error = float(spread.sqrt()) if len(found) > 1 else math.nan
    boxes = sum(len(track.frames) for track in tracks)
    return BoxJitter(_size(found), error, boxes, tuple(_size([each]) for each in found))


def _size(found: Sequence[Sequence[Float64[Tensor, "_ 8 3"]]]) -> float:
    by_order = [torch.cat(order).abs().flatten(0, 1).quantile(0.5, dim=0).norm() for order in zip(*found, strict=True)]
    return _DEVIATION_OF_MEDIAN * float(min(by_order))


def _differences(track: Track, held_out: frozenset[int]) -> list[Float64[Tensor, "_ 8 3"]]:
    """Of the corners in the world, at each order, over boxes of frames that follow each other."""
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
    corners = torch.einsum("fij,cj->fci", track.world_from_object[:, :3, :3], signs * track.size.double())
    corners = corners + track.world_from_object[:, None, :3, 3]
    used = torch.tensor([int(frame) not in held_out for frame in track.frames], dtype=torch.bool)
    frames, corners = track.frames[used], corners[used]
    found = []
    for order in ORDERS:
        weights = torch.tensor([(-1.0) ** i * math.comb(order, i) for i in range(order + 1)], dtype=torch.float64)
        if len(frames) <= order:
            found.append(corners[:0])
            continue
        windows = corners.unfold(0, order + 1, 1) @ weights / math.sqrt(math.comb(2 * order, order))
        found.append(windows[frames[order:] - frames[:-order] == order])
    return found
