"""How far the lidar's edges lie from those of the images: what a wrong calibration, pose or stamp shows first."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.geometry.cameras import project
from sparsestreet.types import Frame

MOST_FRAMES = 36
"""Images that are looked at, in half a second: embedded streets of 240x144 that fit have -0.3 to 0.4 pixels right."""
FEWEST_EDGES = 300
"""Of one direction; fewer say nothing."""
REACH, STEP = 4.0, 0.5
"""Pixels: shifts from -REACH to REACH are tried."""
WIDEST_GAP = 4.0
"""Pixels between two neighboring returns with an edge in between."""
FARTHEST = 40.0
"""Meters of the nearer return of an edge."""


@dataclass(frozen=True)
class EdgeShift:
    """Where the images' edges lie, seen from those of the lidar; pixels of the images as they are read."""

    right: float
    down: float
    edges: int


def edge_shift(frames: Frames, sweeps: Sweeps) -> EdgeShift | None:
    """The shifts, right and down, at which edges of the lidar meet the steepest colors; None where too few are seen.

    An edge lies midway between two returns of a row (or column) of pixels of which one is clearly nearer. The mean
    slope of the gray image at all of them is largest where they belong; a parabola through the best shift and its
    neighbors gives parts of a step. Lidars stand above cameras and look over edges, so ``down`` is -0.4 to -1.0
    where all is right.
    """
    places = {index: place for place, index in enumerate(sweeps.indices)}
    shifts = torch.arange(-REACH, REACH + STEP / 2, STEP)
    slopes, counts = torch.zeros(2, len(shifts)), [0, 0]
    for place in spread(len(frames), MOST_FRAMES):
        index, _ = frames.views[place].indices
        if index not in places:
            continue
        frame = frames[place]
        positions, depths, inside = project(frame.camera, sweeps[places[index]].points)
        if frame.ego is not None:
            column, row = positions[inside].long().unbind(1)
            inside[inside.clone()] = ~frame.ego[row, column]
        for axis in (0, 1):
            edges = _edges(positions[inside], depths[inside], axis, frame)
            slopes[axis] += _slopes(frame, edges, axis, shifts)
            counts[axis] += len(edges)
    if min(counts) < FEWEST_EDGES:
        return None
    return EdgeShift(_peak(slopes[0], shifts), _peak(slopes[1], shifts), sum(counts))


def _edges(positions: Float[Tensor, "n 2"], depths: Float[Tensor, " n"], axis: int, frame: Frame) -> Tensor:
    """Image positions of the edges along an axis (0: x), far enough from the border to be shifted."""
    lines = positions[:, 1 - axis].floor()
    order = torch.argsort(lines.double() * 1e6 + positions[:, axis].double())
    positions, depths, lines = positions[order], depths[order], lines[order]
    gaps = positions[1:, axis] - positions[:-1, axis]
    nearer, farther = torch.minimum(depths[1:], depths[:-1]), torch.maximum(depths[1:], depths[:-1])
    neighbors = (lines[1:] == lines[:-1]) & (gaps > 0) & (gaps <= WIDEST_GAP)
    found = neighbors & (farther > 1.15 * nearer + 0.5) & (nearer < FARTHEST)
    middles = (positions[1:] + positions[:-1])[found] / 2
    border = torch.tensor([frame.camera.width, frame.camera.height]) - REACH - 1
    return middles[((middles > REACH + 1) & (middles < border)).all(1)]


def _slopes(frame: Frame, edges: Float[Tensor, "n 2"], axis: int, shifts: Float[Tensor, " s"]) -> Float[Tensor, " s"]:
    """Sum of the gray image's slope along the axis at the edges, for each shift along it."""
    slope = torch.gradient(frame.image.float().mean(-1), dim=1 - axis)[0].abs()
    at = edges.expand(len(shifts), *edges.shape).clone()
    at[..., axis] += shifts[:, None]
    size = torch.tensor([frame.camera.width, frame.camera.height])
    return grid_sample(slope[None, None], (2 * at / size - 1)[None], align_corners=False)[0, 0].sum(1)


def _peak(slopes: Float[Tensor, " s"], shifts: Float[Tensor, " s"]) -> float:
    best = int(slopes.argmax())
    if best in (0, len(shifts) - 1):
        return float(shifts[best])
    before, here, behind = slopes[best - 1 : best + 2].tolist()
    return float(shifts[best]) + STEP * (before - behind) / (2 * (before - 2 * here + behind))
