"""Size and kind of an object, and where its middle was, from the outlines of its returns in its own frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sparsestreet.tracking.objects import USUAL_SIZES, Kind
from sparsestreet.tracking.path import in_frame, turned
from sparsestreet.tracking.scans import Returns

OUTLINE = (0.01, 0.99)
"""Quantiles of the coordinates that bound the returns of an object."""
SEEN_SPAN = 0.9
"""Quantile, over instants, of what is seen of a length: an instant that shows all of it is rare, one that shows more
is noise."""
MIN_FULL_LENGTH = 3.3
"""Meters: of a vehicle that never shows more, only its back or front was seen."""
LARGE_WIDTH, LARGE_HEIGHT, MIN_LARGE_LENGTH, LARGE_LENGTH = 2.1, 2.6, 6.0, 10.0
"""Meters: buses, trucks and trams are so wide and high. Of one that shows less than the third number only an end is
seen; the last is then its length. What shows less than the last may be longer by as much."""
PADDING = (0.2, 0.05)
"""Meters of length and width that the quantiles leave out: bumpers, and the rounded sides."""
MAX_LENGTH, MAX_WIDTH, MAX_HEIGHT = 30.0, 3.0, 4.2
"""Meters."""
MIN_UNSURE = 0.1
"""Meters by which a side may be off that is seen from end to end."""
WHOLE = 0.8
"""Share of its length that an instant must show to say where the middle of a vehicle is."""


@dataclass(frozen=True)
class Shape:
    """What an object is, and how large."""

    kind: Kind
    size: Float64[np.ndarray, "3"]
    """Length, width, height, meters."""
    unsure: Float64[np.ndarray, "3"]
    """Meters by which each may be off."""


def outlines(
    parts: Sequence[Returns], path: Float64[np.ndarray, "n 2"], yaw: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 2 2"]:
    """Return for each instant the lowest and the highest x and y of its returns in the object's frame."""
    local = (in_frame(part.points, *pose) for part, *pose in zip(parts, path, yaw, strict=True))
    return np.array([np.quantile(points, OUTLINE, axis=0) for points in local])


def kind_of(length: float, width: float, speed: float) -> Kind:
    """Return what has these sides, meters, and this median speed, meters per second."""
    if length > 2.6 or width > 1.25:
        return "vehicle"
    return "cyclist" if length > 1.25 or speed > 2.6 else "pedestrian"


def find_shape(
    outline: Float64[np.ndarray, "n 2 2"], counts: Int64[np.ndarray, " n"], height: float, speed: float
) -> Shape:
    """Return kind and size.

    Args:
        outline: of each instant.
        counts: of its returns; instants with few of them show too little.
        height: of the highest returns above the road, meters.
        speed: median, meters per second.
    """
    shown = counts >= min(10.0, float(np.quantile(counts, 0.7)))
    seen = np.array([*np.quantile((outline[:, 1] - outline[:, 0])[shown], SEEN_SPAN, axis=0), height])
    kind = kind_of(seen[0], seen[1], speed)
    usual = np.array(USUAL_SIZES[kind])
    if kind != "vehicle":
        size = np.maximum(seen + np.array((0.2, 0.1, 0.0)), usual)
        size[2] = min(size[2], MAX_HEIGHT)
        return Shape(kind, size, np.maximum(MIN_UNSURE, size - seen))
    size, unsure = seen.copy(), np.full(3, MIN_UNSURE)
    if seen[0] < LARGE_LENGTH and seen[1] > LARGE_WIDTH and seen[2] > LARGE_HEIGHT:
        size[0] = LARGE_LENGTH if seen[0] < MIN_LARGE_LENGTH else seen[0]
        unsure[0] = LARGE_LENGTH
    elif seen[0] < MIN_FULL_LENGTH:
        size[0] = usual[0]
    size[1] = max(seen[1], 1.6 if size[0] > 3 else usual[1])
    size[:2] = np.minimum(size[:2] + np.array(PADDING), (MAX_LENGTH, MAX_WIDTH))
    size[2] = np.clip(seen[2], 0.9 * usual[2], MAX_HEIGHT)
    return Shape(kind, size, np.maximum(unsure, np.abs(size - seen)))


def find_middles(
    parts: Sequence[Returns],
    outline: Float64[np.ndarray, "n 2 2"],
    shape: Shape,
    path: Float64[np.ndarray, "n 2"],
    yaw: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Return where each instant puts the middle, meters, world, and its weight.

    The sides of a vehicle that face the lidar are where they are seen, and the far ones a size away. People and
    cyclists are round: they are as wide to the left of the middle of their outline as to its right.
    """
    half = shape.size[:2] / 2
    low, high = outline[:, 0], outline[:, 1]
    origins = np.array([part.origins[:, :2].mean(0) for part in parts])
    lidar = turned(origins - path, -yaw)
    lean = np.clip(lidar / half, -1, 1)  # 1: the front (left side) faces the lidar
    facing = (1 + lean) / 2 * (high - half) + (1 - lean) / 2 * (low + half)
    local = facing if shape.kind == "vehicle" else (low + high) / 2
    whole = (high - low)[:, 0] / shape.size[0] > WHOLE
    # Close by, beams pass over wheels and hood: what is seen of the length then tells little of the middle.
    end_on = (np.abs(lean[:, 0]) == 1) & (shape.kind == "vehicle")
    weights = np.where(whole, 1.0, np.where(end_on, 0.3, 0.03))
    return path + turned(local, yaw), weights
