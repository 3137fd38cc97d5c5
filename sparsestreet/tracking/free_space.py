"""What moves: returns at places that other scans of the drive see through."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy import sparse
from scipy.spatial import KDTree

from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings

MIN_RANGE = 1.5
"""Meters; nearer places are the recording car's."""
MIN_RAYS = 2
"""Rays around a place's direction without which a scan says nothing of it."""
BLOCKS = (1, 2)
"""Sizes of bins, as multiples of the settings' ones: lidars of few beams leave the small ones empty."""


@dataclass(frozen=True)
class RangeImage:
    """The rays of a scan in bins of direction: in each block of 2 x 2 bins the nearest range and the number of rays."""

    nearest: Float32[np.ndarray, "a e"]
    """Meters, by azimuth, which wraps around, and elevation; infinite without a ray."""
    rays: Int64[np.ndarray, "a e"]

    @staticmethod
    def of(polar: "Polar", azimuth_bin: float, elevation_bin: float) -> "RangeImage":
        """Return the image of the returns of a scan; bins in degrees."""
        shape = round(360 / azimuth_bin), int(np.ceil(180 / elevation_bin)) + 1
        rows, columns = polar.bins(shape, elevation_bin)
        bins = (rows.astype(np.int64) % shape[0]) * shape[1] + columns.astype(np.int64)
        nearest = np.full(shape[0] * shape[1], np.inf, np.float32)
        np.minimum.at(nearest, bins, polar.ranges.astype(np.float32))
        nearest = nearest.reshape(shape)
        rays = np.bincount(bins, minlength=nearest.size).reshape(shape)
        nearest = np.minimum(nearest, np.roll(nearest, -1, 0))
        nearest[:, :-1] = np.minimum(nearest[:, :-1], nearest[:, 1:])
        rays = rays + np.roll(rays, -1, 0)
        rays[:, :-1] += rays[:, 1:].copy()
        return RangeImage(nearest, rays)

    def ahead(self, polar: "Polar", elevation_bin: float) -> tuple[Float32[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        """Return for each place the nearest range, and the number, of the rays in the block with the nearest middle."""
        shape = self.nearest.shape
        rows, columns = polar.bins(shape, elevation_bin)
        block = np.floor(rows - 0.5).astype(np.int64) % shape[0]
        level = np.clip(np.floor(columns - 0.5).astype(np.int64), 0, shape[1] - 1)
        return self.nearest[block, level], self.rays[block, level]


@dataclass(frozen=True)
class Polar:
    """Places as a lidar sees them."""

    ranges: Float64[np.ndarray, " n"]
    azimuth: Float64[np.ndarray, " n"]
    """Turns, from 0 to 1."""
    elevation: Float64[np.ndarray, " n"]
    """Degrees above straight down."""

    @staticmethod
    def of(offsets: Float64[np.ndarray, "n 3"]) -> "Polar":
        """Return places given from their lidar, meters, along the axes of the world."""
        plan = np.hypot(offsets[:, 0], offsets[:, 1])
        azimuth = np.arctan2(offsets[:, 1], offsets[:, 0]) / (2 * np.pi) + 0.5
        return Polar(np.hypot(plan, offsets[:, 2]), azimuth, np.degrees(np.arctan2(offsets[:, 2], plan)) + 90)

    def bins(
        self, shape: tuple[int, ...], elevation_bin: float
    ) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return where they lie in an image of this shape, in bins."""
        return self.azimuth * shape[0], self.elevation / elevation_bin


def seen_through(
    returns: Float64[np.ndarray, "n 3"], places: Float64[np.ndarray, "c 3"], settings: TrackingSettings
) -> Bool[np.ndarray, " c"]:
    """Return which places a scan sees through: all rays around them end behind. Both are given from the lidar, meters.

    The rays are those of a block of 2 x 2 bins, and where these are fewer than two, of one twice as large. A ray that
    never came back says nothing.
    """
    rays, seen = Polar.of(returns), Polar.of(places)
    nearest, enough = np.full(len(places), np.inf, np.float32), np.zeros(len(places), bool)
    for scale in BLOCKS:
        azimuth_bin, elevation_bin = scale * settings.azimuth_bin, scale * settings.elevation_bin
        ahead, count = RangeImage.of(rays, azimuth_bin, elevation_bin).ahead(seen, elevation_bin)
        nearest = np.where(enough, nearest, ahead)
        enough |= count >= MIN_RAYS
    behind = np.maximum(settings.behind, settings.behind_share * seen.ranges)
    return enough & (nearest > seen.ranges + behind) & (seen.ranges > MIN_RANGE)


@dataclass(frozen=True)
class Cells:
    """The places of a drive that have returns: cells of a grid, each at the mean of its returns."""

    means: Float64[np.ndarray, "c 3"]
    rows: tuple[Int64[np.ndarray, " _"], ...]
    """For each scan, the cell of each return."""
    near: sparse.csr_matrix
    """Which cells are so near to each other that a return in one occupies the other, itself included."""

    @staticmethod
    def of(scans: Sequence[Float64[np.ndarray, "_ 3"]], settings: TrackingSettings) -> "Cells":
        """Return the cells of the returns of scans."""
        every = np.concatenate([np.zeros((0, 3)), *scans])
        keys = packed(every, settings.voxel)
        _, cell, count = np.unique(keys, return_inverse=True, return_counts=True)
        means = np.stack([np.bincount(cell, every[:, axis], len(count)) / count for axis in range(3)], 1)
        rows = np.split(cell.reshape(-1), np.cumsum([len(points) for points in scans])[:-1])
        return Cells(means, tuple(rows), _near(means, settings.reach))


def packed(points: Float64[np.ndarray, "n 3"], side: float) -> Int64[np.ndarray, " n"]:
    """Return the grid cell of each point as one number; 21 bits an axis hold any drive."""
    cells = np.floor(points / side).astype(np.int64) + (1 << 20)
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _near(places: Float64[np.ndarray, "c 3"], reach: float) -> sparse.csr_matrix:
    pairs = KDTree(places).query_pairs(reach, output_type="ndarray") if len(places) else np.zeros((0, 2), np.int64)
    ones, shape = np.ones(len(pairs), np.float32), (len(places), len(places))
    one_way = sparse.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=shape).tocsr()
    return (one_way + one_way.T + sparse.diags(np.ones(len(places), np.float32))).tocsr()


def count_views(
    scans: Sequence[Scan],
    candidates: Sequence[Float64[np.ndarray, "_ 3"]],
    settings: TrackingSettings,
    report: Callable[[int, int], None],
) -> tuple[list[Int64[np.ndarray, " _"]], list[Int64[np.ndarray, " _"]]]:
    """Return for each candidate of each scan in how many scans its place is occupied, and through how many it is seen.

    Args:
        scans: all returns; those on the road show that a ray passed what stands before it.
        candidates: those of each scan that may be on objects, meters, world.
        settings: what counts as occupied, and as seen through.
        report: called with the number of scans done and of all scans.
    """
    cells = Cells.of(candidates, settings)
    occupied, free = np.zeros((2, len(cells.means)), np.int64)
    for number, (scan, rows) in enumerate(zip(scans, cells.rows, strict=True)):
        here = np.zeros(len(cells.means), np.float32)
        here[rows] = 1
        taken = cells.near @ here > 0
        free += seen_through(scan.points - scan.origin, cells.means - scan.origin, settings) & ~taken
        occupied += taken
        report(number + 1, len(scans))
    return [occupied[rows] for rows in cells.rows], [free[rows] for rows in cells.rows]
