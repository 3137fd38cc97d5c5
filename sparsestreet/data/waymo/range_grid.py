"""Rays of a range image that points fit best, and the points on them: the way back from ``lidar.world_points``.

A sensor whose beams and steps are even is found again, so that its points stay. Other points move to the nearest ray.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from sparsestreet.data.waymo.lidar import FARTHEST

_EXACT = 1e-4
"""Radians within which rays count as one: float32 points of a log vary by a tenth of it."""
_SAMPLE = 1_000
_MOST_OUTLIERS = 0.01
"""Of the sample, that may lie farther from the middle of a column: returns next to the sensor vary more."""
_STEP = 1e-6
_HALVINGS = 24
_RETURNS = 2


@dataclass(frozen=True)
class Placed:
    """Points of a sweep as both range images of a lidar."""

    ranges: Float32[np.ndarray, "2 h w"]
    """Meters, of the nearest and the second point of each ray; -1 where there is none."""
    moved: Float64[np.ndarray, " k"]
    """Meters, of each point that has a place."""
    lost: int
    """Points without: a third one of a ray, or too near or far to be a return."""

    def image(self, number: int) -> Float32[np.ndarray, "h w 4"]:
        """Range, intensity, elongation and whether no label is there, of a return: the log tells the first alone."""
        ranges = self.ranges[number]
        image = np.where(ranges[..., None] > 0, np.float32(0), np.float32(-1)).repeat(4, -1)
        image[..., 0] = ranges
        return image


@dataclass(frozen=True)
class RangeGrid:
    """Rays from one place, in axes x ahead, y left, z up."""

    inclinations: Float64[np.ndarray, " h"]
    """Of the beams, ascending, radians."""
    columns: int

    @classmethod
    def fitting(cls, sweeps: Iterable[Float64[np.ndarray, "n 3"]], most_rows: int, most_columns: int) -> "RangeGrid":
        """The rays for points as the sensor sees them.

        Rows are the fewest angles with all points within ``_EXACT``, or ``most_rows`` with the least largest distance;
        columns the fewest whose middles the points are in, or else ``most_columns``.
        """
        steps, counts, azimuths = np.zeros(0, np.int64), np.zeros(0, np.int64), []
        for points in sweeps:
            _, azimuth, inclination = _polar(points)
            new, of_new = np.unique(np.round(inclination / _STEP).astype(np.int64), return_counts=True)
            steps, places = np.unique(np.concatenate((steps, new)), return_inverse=True)
            counts = np.bincount(places, np.concatenate((counts, of_new))).astype(np.int64)
            azimuths.append(azimuth[:: max(1, len(azimuth) // 100)])
        if not len(steps):
            return cls(np.zeros(1), 1)
        columns = _even_columns(np.concatenate(azimuths), most_columns)
        return cls(_rows(steps * _STEP, counts, most_rows), columns or most_columns)

    def place(self, points: Float64[np.ndarray, "n 3"]) -> Placed:
        """Each point goes to the nearest place of its ray; of more than two on a ray the nearest two stay."""
        height, ranges = len(self.inclinations), np.full((_RETURNS, len(self.inclinations) * self.columns), -1.0)
        distance, azimuth, inclination = _polar(points)
        between = (self.inclinations[1:] + self.inclinations[:-1]) / 2
        beams = np.searchsorted(between, inclination)
        columns = np.floor(self.columns * (0.5 - azimuth / (2 * np.pi))).astype(np.int64) % self.columns
        azimuth = np.pi * (1 - (2 * columns + 1) / self.columns)
        flat = np.cos(self.inclinations[beams])
        rays = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(self.inclinations[beams])), -1)
        along = np.einsum("ni,ni->n", rays, points)
        pixels = (height - 1 - beams) * self.columns + columns
        order = np.lexsort((along, pixels))
        order = order[(along[order] > 0) & (distance[order] < FARTHEST)]
        number = _numbers(pixels[order])
        for place in range(_RETURNS):
            some = order[number == place]
            ranges[place, pixels[some]] = along[some]
        kept = order[number < _RETURNS]
        moved = np.linalg.norm(points[kept] - along[kept, None] * rays[kept], axis=1)
        shape = (_RETURNS, height, self.columns)
        return Placed(ranges.astype(np.float32).reshape(shape), moved, len(points) - len(kept))


def _polar(points: Float64[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance, azimuth and inclination."""
    x, y, z = points.T
    flat = np.hypot(x, y)
    return np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)


def _numbers(pixels: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """How many of the same pixel are ahead of each, in sorted pixels."""
    starts = np.flatnonzero(np.diff(pixels, prepend=-1))
    return np.arange(len(pixels)) - np.repeat(starts, np.diff(starts, append=len(pixels)))


def _rows(angles: Float64[np.ndarray, " n"], counts: np.ndarray, most: int) -> Float64[np.ndarray, " h"]:
    """Means of the groups of sorted angles; groups are as narrow as their number allows."""
    narrow, wide = 0.0, max(_EXACT, float(angles[-1] - angles[0]))
    starts = _groups(angles, _EXACT, most)
    if starts is None:
        for _ in range(_HALVINGS):
            width = (narrow + wide) / 2
            narrow, wide = (width, wide) if _groups(angles, width, most) is None else (narrow, width)
        starts = _groups(angles, wide, most)
    assert starts is not None  # one group holds them all
    return np.add.reduceat(angles * counts, starts) / np.add.reduceat(counts, starts)


def _groups(angles: Float64[np.ndarray, " n"], width: float, most: int) -> list[int] | None:
    """Where groups of at most ``width`` begin; None where there would be more than ``most``."""
    starts, place = [], 0
    while place < len(angles):
        if len(starts) == most:
            return None
        starts.append(place)
        place = int(np.searchsorted(angles, angles[place] + width, side="right"))
    return starts


def _even_columns(azimuths: Float64[np.ndarray, " n"], most: int) -> int | None:
    """The fewest columns with the azimuths in their middles; None where there are no such up to ``most``."""
    turns = 0.5 - azimuths[:: max(1, len(azimuths) // _SAMPLE)] / (2 * np.pi)
    for columns in range(1, most + 1):
        off = np.abs(turns * columns % 1 - 0.5) * (2 * np.pi / columns)
        if np.count_nonzero(off > _EXACT) <= _MOST_OUTLIERS * len(off):
            return columns
    return None
