"""One shape and one smooth path that explain all returns of a chain."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from sparsestreet.tracking.association import Chain
from sparsestreet.tracking.ground import Ground
from sparsestreet.tracking.objects import Kind
from sparsestreet.tracking.path import HEADING_REACH, MIN_SPEED, headings, in_frame, smooth, turned
from sparsestreet.tracking.scans import Returns
from sparsestreet.tracking.shape import Shape, find_middles, find_shape, outlines

ROUNDS = 4
"""How often headings and shape, which depend on the path, and the path, which depends on them, are computed in turn."""
FIRST_STIFFNESS, STIFFNESS, HEIGHT_STIFFNESS = 30.0, 60.0, 100.0
"""Of the path through middles of clusters, of the path through middles of boxes, and of heights (``path.smooth``)."""
TURNING_SPEEDS: dict[Kind, float] = {"vehicle": 1.0, "cyclist": 1.0, "pedestrian": MIN_SPEED}
"""Meters per second, below which the heading is held: what has wheels does not move sideways, its noise does."""
MAX_REACH = 2.0
"""Seconds, the longest over which a heading is taken to both sides."""
MANY_RETURNS = 20
"""Returns of an instant with the full weight."""


@dataclass(frozen=True)
class Box:
    """A place of an object."""

    middle: Float64[np.ndarray, "2"]
    """In plan, meters, world."""
    yaw: float
    bottom: float
    """Height of the road."""
    size: Float64[np.ndarray, "3"]


@dataclass(frozen=True)
class Fit:
    """An object at every step from its first to its last."""

    steps: Int64[np.ndarray, " s"]
    path: Float64[np.ndarray, "s 2"]
    """Middle of the box in plan, meters, world."""
    yaw: Float64[np.ndarray, " s"]
    speed: Float64[np.ndarray, " s"]
    bottom: Float64[np.ndarray, " s"]
    """Height of the road below it."""
    shape: Shape
    counts: Int64[np.ndarray, " s"]
    """Returns of a step; 0 where none was seen."""
    error: float
    """Median distance from the path to where single instants put the middle, meters."""

    def at(self, step: int) -> Box:
        """Return the box at a step between the first and the last."""
        row = step - int(self.steps[0])
        return Box(self.path[row], float(self.yaw[row]), float(self.bottom[row]), self.shape.size)


def fit(chain: Chain, seconds: Float64[np.ndarray, " t"], ground: Ground, *, refine: bool) -> Fit:
    """Return shape and path of a chain.

    Args:
        chain: returns of one object.
        seconds: time of every step of the drive.
        ground: heights of the road.
        refine: whether returns of instants are laid upon each other at the end.
    """
    steps, parts = chain.steps, chain.parts
    own, at = seconds[steps[0] : steps[-1] + 1], steps - steps[0]
    counts = np.array([len(part) for part in parts])
    weights = np.clip(counts / MANY_RETURNS, 0.1, 1)
    middles = np.array([np.quantile(part.points[:, :2], (0.02, 0.98), axis=0).mean(0) for part in parts])
    tops = np.array([np.quantile(part.points[:, 2], 0.98) for part in parts]) - ground.below(middles)
    path = smooth(steps, middles, weights, seconds, FIRST_STIFFNESS)
    turn = partial(headings, seconds=own, min_speed=MIN_SPEED)
    for _ in range(ROUNDS):
        yaw, speed = turn(path)
        outline = outlines(parts, path[at], yaw[at])
        usual_speed = float(np.median(speed[speed >= min(MIN_SPEED, speed.max())]))
        shape = find_shape(outline, counts, float(np.quantile(tops, 0.8)), usual_speed)
        turn = partial(
            headings,
            seconds=own,
            min_speed=TURNING_SPEEDS[shape.kind],
            reverses=shape.kind == "vehicle",
            # What is long turns slowly: its direction is that over its own length.
            reach=max(HEADING_REACH, min(MAX_REACH, shape.size[0] / 2 / max(usual_speed, MIN_SPEED))),
        )
        middles, sure = find_middles(parts, outline, shape, path[at], yaw[at])
        path = smooth(steps, middles, weights * sure, seconds, STIFFNESS)
    if refine:
        shifts = laid_on_each_other(parts, path[at], turn(path)[0][at], weights)
        path = smooth(steps, path[at] + shifts, weights, seconds, STIFFNESS)
    yaw, speed = turn(path)
    every = np.arange(steps[0], steps[-1] + 1)
    bottom = smooth(every, ground.below(path)[:, None], np.ones(len(every)), seconds, HEIGHT_STIFFNESS)[:, 0]
    seen = np.zeros(len(every), np.int64)
    seen[at] = counts
    error = float(np.median(np.linalg.norm(path[at] - middles, axis=1)))
    return Fit(every, path, yaw, speed, bottom, shape, seen, error)


REGISTRATION_ROUNDS, REGISTRATION_GAIN = 6, 1.5
"""Nearest neighbors lie less far away than the same place does, so more than the mean is made up for."""
REGISTRATION_REACH = 15
"""Instants of the chain before and behind whose returns an instant is laid upon."""
REGISTERED_RETURNS = 80
"""Most returns of an instant that are compared."""
MIN_COMPARED = 8
"""Returns below which an instant is left where it is."""
MAX_GAP, MAX_SHIFT = 0.4, 0.15
"""Meters: farthest neighbor that is compared, and farthest shift of a round along an axis."""


def laid_on_each_other(
    parts: Sequence[Returns],
    path: Float64[np.ndarray, "n 2"],
    yaw: Float64[np.ndarray, " n"],
    weights: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 2"]:
    """Return the shift of the path at each instant, meters, world, by which its returns fall on those around it.

    Each is moved towards its nearest neighbors in turn. The mean shift is none, so the box stays on the object.
    """
    few = [part.thinned(REGISTERED_RETURNS) for part in parts]
    owner = np.repeat(np.arange(len(few)), [len(part) for part in few])
    heights = np.concatenate([part.points[:, 2] for part in few])
    plan = np.concatenate([in_frame(part.points, *pose) for part, *pose in zip(few, path, yaw, strict=True)])
    offset = np.zeros((len(few), 2))
    for _ in range(REGISTRATION_ROUNDS):
        model = np.column_stack((plan + offset[owner], heights))
        for number in range(len(few)):
            mine = model[owner == number]
            others = model[(owner != number) & (np.abs(owner - number) <= REGISTRATION_REACH)]
            if min(len(mine), len(others)) < MIN_COMPARED:
                continue
            gaps, nearest = map(np.asarray, KDTree(others).query(mine, distance_upper_bound=MAX_GAP))
            close = np.isfinite(gaps)
            if close.mean() >= 0.5:
                mean = (others[nearest[close], :2] - mine[close, :2]).mean(0)
                offset[number] += np.clip(REGISTRATION_GAIN * mean, -MAX_SHIFT, MAX_SHIFT)
        offset -= np.average(offset, axis=0, weights=weights)
    # What must move ahead to fall on the others was put too far ahead: its box goes back.
    return -turned(offset, yaw)
