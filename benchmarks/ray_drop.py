"""Which rays of recorded sweeps return nothing, and who could know: ``python -m benchmarks.ray_drop NAME=FILE,... ...``

A ray counts if its row has returns on both sides, at most MAX_GAP columns apart: what it would meet lies between. A
logistic regression on what a drawn sweep has too (range, incidence, edges, elevation) is fitted on all logs but one.
Files: KITTI raw's .bin (rows by azimuth), nuScenes' .pcd.bin (32 rows as fired), Argoverse 2's .feather.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.feather
from jaxtyping import Bool, Float64

from sparsestreet.cli.commands.bench import record_file

MAX_GAP, MIN_RANGE, EDGE = 13, 3.0, 1.2
"""Columns, meters (nearer: the car itself), and ratio of neighboring ranges of two surfaces."""
Grid = Float64[np.ndarray, "rows columns 3"]
"""Points from their sensor, from the top row down; NaN: no return, infinite: no ray."""


@dataclass(frozen=True)
class RayDrop:
    """Percent of the rays of a log: ``false_drops`` of the returned and ``edges`` of the dropped ones are at edges; the
    model has ``found`` of the dropped at as many false drops."""

    log: str
    rays: int
    returned: float
    right: float
    balanced: float
    false_drops: float
    edges: float
    found: float


def grids(path: Path) -> list[Grid]:
    """Return the sweeps of a file."""
    if path.suffix == ".feather":
        table = pyarrow.feather.read_table(path).to_pydict()
        laser, slots = np.array(table["laser_number"]), np.array(table["offset_ns"]) // 55296  # ns between firings
        points = np.stack([np.array(table[axis], float) for axis in "xyz"], 1) - (1.35, 0.0, 1.58)
        return [_grid(laser[one] % 32, slots[one], points[one]) for one in (laser < 32, laser >= 32)]
    if path.name.endswith(".pcd.bin"):
        points = np.fromfile(path, "<f4").reshape(-1, 5)[:, :3].astype(float)
        points[np.linalg.norm(points, axis=1) < 0.6] = np.nan  # where the sensor is at the stamp
        return [points.reshape(-1, 32, 3).transpose(1, 0, 2)[::-1]]
    points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3].astype(float)
    azimuths = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    rows = np.r_[0, np.cumsum((azimuths[:-1] > 300) & (azimuths[1:] < 60))]
    steps = np.maximum(np.diff(azimuths, prepend=0), 0)  # 0.09 or 0.18 degrees, 0.17 on average
    columns = np.cumsum(np.where(steps < 0.26, 1, (steps / 0.17).round())).astype(int)
    return [_grid(rows, columns - columns[np.searchsorted(rows, rows)], points)]


def _grid(rows: np.ndarray, columns: np.ndarray, points: Float64[np.ndarray, "n 3"]) -> Grid:
    made = np.full((rows.max() + 1, columns.max() - columns.min() + 1, 3), np.nan)
    made[rows, columns - columns.min()] = points
    return made[np.argsort(-np.nanmedian(made[..., 2] / np.linalg.norm(made, axis=-1), 1))]


def enclosed(grid: Grid) -> tuple[Float64[np.ndarray, "n 8"], Bool[np.ndarray, " n"]]:
    """Return what is known of each ray with returns on both sides, and whether it returned nothing."""
    ranges, (_, width, _) = np.linalg.norm(grid, axis=-1), grid.shape
    back, places = np.isfinite(ranges), np.broadcast_to(np.arange(width), ranges.shape)
    left = np.roll(np.maximum.accumulate(np.where(back, places, -width), 1), 1, 1)
    right = np.roll(np.minimum.accumulate(np.where(back, places, 2 * width)[:, ::-1], 1)[:, ::-1], -1, 1)
    held = (right - left <= MAX_GAP + 1) & (left < places) & (places < right)
    row, column = np.nonzero(held & (left >= 0) & (right < width))
    before, behind = left[row, column], right[row, column]
    near, far = np.sort((ranges[row, before], ranges[row, behind]), 0)
    first, last = grid[row, before], grid[row, behind]
    between = first + ((column - before) / (behind - before))[:, None] * (last - first)
    edge = far > EDGE * near
    met = np.where(edge, near, straight := np.linalg.norm(between, axis=1))
    other = grid[(above := np.abs(row - 1)), left[above, column].clip(0)]  # columns are lost together: not of this one
    beside = np.where(np.abs(np.linalg.norm(other, axis=1) / met - 1)[:, None] < 0.35, other, np.nan)
    normal = np.cross(last - first, beside - between)
    cosine = np.abs((normal * between).sum(1)) / np.linalg.norm(normal, axis=1) / straight
    incidence = np.log(np.where(edge | np.isnan(cosine), 0.5, np.clip(cosine, 0.02, 1)))
    up, away = 0.1 * np.degrees(np.arcsin(between[:, 2] / straight)), np.log(met) - 3
    known = np.stack((np.ones_like(up), away, away**2, incidence, edge, up, up**2, away * edge), 1)
    return known[met > MIN_RANGE], ~back[row, column][met > MIN_RANGE]


def fitted(known: Float64[np.ndarray, "n k"], dropped: Bool[np.ndarray, " n"]) -> Float64[np.ndarray, " k"]:
    """Return the weights of a logistic regression, by Newton's method with a ridge of 1."""
    weights = np.zeros(known.shape[1])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-known @ weights))
        curvature = (known * (chance * (1 - chance))[:, None]).T @ known + np.eye(len(weights))
        weights -= np.linalg.solve(curvature, known.T @ (chance - dropped) + weights)
    return weights


def judged(logs: dict[str, list[Path]]) -> Iterator[RayDrop]:
    """Yield what the other logs say of each."""
    parts = {name: [enclosed(grid) for path in paths for grid in grids(path)] for name, paths in logs.items()}
    for log in logs:
        others = [part for other, found in parts.items() if other != log for part in found]
        weights = fitted(*(np.concatenate(one) for one in zip(*others, strict=True)))
        known, dropped = (np.concatenate(one) for one in zip(*parts[log], strict=True))
        score, edge = known @ weights, known[:, 4] > 0
        right, false_drops = (score > 0) == dropped, edge[~dropped].mean()
        found = (score[dropped] > np.quantile(score[~dropped], 1 - false_drops)).mean()
        balanced = (right[dropped].mean() + right[~dropped].mean()) / 2
        shares = ((~dropped).mean(), right.mean(), balanced, false_drops, edge[dropped].mean(), found)
        yield RayDrop(log, len(dropped), *(100 * float(share) for share in shares))


if __name__ == "__main__":
    said = dict(word.split("=") for word in sys.argv[1:])
    command = " ".join(["python -m benchmarks.ray_drop", *(f"{name}=FILES" for name in said)])
    file = record_file(Path("outputs/bench"), "ray_drop", command)
    for record in judged({name: [Path(one) for one in files.split(",")] for name, files in said.items()}):
        file.write("ray_drop", record)
        print(record)
