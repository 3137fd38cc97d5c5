"""Heights of the road below a drive, from the lowest returns of its scans."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage

CELL = 0.5
"""Meters, side of a cell of the map."""
LOW_QUANTILE = 0.2
"""The lowest return of a cell in a scan may be one from below the road, as mirrors and wet roads give: not the lowest
of all scans counts, but this quantile."""
STANDING_SPAN, STANDING_STEP = 11, 0.5
"""Cells across, and meters: what rises more above the lowest cell around it is no road, but something that stands."""

LOW_PERCENTILE = 25
"""Percentile of the cells around a cell, below which by the same step it is no road either."""


@dataclass(frozen=True)
class Ground:
    """A map of heights. Outside of it, and in cells without a return, the nearest known cell counts."""

    heights: Float64[np.ndarray, "x y"]
    corner: Float64[np.ndarray, "2"]
    """Where the first cell begins."""

    def below(self, places: Float[np.ndarray, "n d"]) -> Float64[np.ndarray, " n"]:
        """Return the height of the road below places, of which x and y count."""
        cells = ((places[:, :2] - self.corner) / CELL).astype(np.int64)
        cells = np.clip(cells, 0, np.array(self.heights.shape) - 1)
        return self.heights[cells[:, 0], cells[:, 1]]


def find_ground(scans: Iterable[Float[np.ndarray, "n 3"]]) -> Ground:
    """Return the heights below the returns of scans; a flat map at 0 where there are none."""
    lows = np.concatenate([np.zeros((0, 3)), *map(_lowest_of_cells, scans)])
    if not len(lows):
        return Ground(np.zeros((1, 1)), np.zeros(2))
    corner = np.floor(lows[:, :2].min(0) / CELL) * CELL
    cells = ((lows[:, :2] - corner) / CELL).astype(np.int64)
    shape = tuple(cells.max(0) + 1)
    key = cells[:, 0] * shape[1] + cells[:, 1]
    order = np.array(np.lexsort((lows[:, 2], key)))
    ids, start, count = np.unique(key[order], return_index=True, return_counts=True)
    heights = np.full(shape, np.nan)
    heights.flat[ids] = lows[order, 2][start + (LOW_QUANTILE * (count - 1)).astype(np.int64)]
    plane = _plane(heights)
    return Ground(_without_what_stands(heights - plane) + plane, corner)


def _lowest_of_cells(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """The lowest return of each cell of one scan, so that a scan has one voice a cell however dense it is."""
    if not len(points):
        return points
    cells = np.floor(points[:, :2] / CELL).astype(np.int64)
    order = np.array(np.lexsort((points[:, 2], cells[:, 1], cells[:, 0])))
    cells = cells[order]
    first = np.concatenate(([True], (cells[1:] != cells[:-1]).any(1)))
    return points[order[first]]


def _plane(heights: Float64[np.ndarray, "x y"]) -> Float64[np.ndarray, "x y"]:
    """The plane through most of the low cells, at every cell: a street that climbs must not look like a step."""
    grid = np.indices(heights.shape, np.float64)
    known = np.isfinite(heights)
    table = np.stack((np.ones(int(known.sum())), grid[0][known], grid[1][known]), 1)
    values, weights = heights[known], np.ones(len(table))
    for _ in range(8):
        root = np.sqrt(weights)
        found = np.asarray(np.linalg.lstsq(table * root[:, None], values * root, rcond=None)[0])
        error = values - table @ found
        # What stands lies far from the road: errors count less the larger they are.
        weights = 1 / (1 + (error / 0.2) ** 2)
    return found[0] + found[1] * grid[0] + found[2] * grid[1]


def _without_what_stands(heights: Float64[np.ndarray, "x y"]) -> Float64[np.ndarray, "x y"]:
    """Heights of all cells, those of walls, cars and cells without a return from the nearest of the road.

    A cell far below those around it, as a mirror in a wet road makes, would make these look as if they stood.
    """
    around = ndimage.percentile_filter(_filled(heights, np.isfinite(heights)), LOW_PERCENTILE, size=5)
    heights = np.where(heights > around - STANDING_STEP, heights, np.nan)  # False for NaN
    lowest = ndimage.minimum_filter(np.where(np.isnan(heights), np.inf, heights), size=STANDING_SPAN)
    return ndimage.median_filter(_filled(heights, heights < lowest + STANDING_STEP), size=5)


def _filled(heights: Float64[np.ndarray, "x y"], known: Bool[np.ndarray, "x y"]) -> Float64[np.ndarray, "x y"]:
    """Heights with those of the nearest known cell where it is not known."""
    nearest = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    return heights[tuple(nearest)]
