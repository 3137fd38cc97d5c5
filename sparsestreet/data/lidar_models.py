"""Lidars by name or file: the angles of their rays, and when each is fired.

A lidar has x ahead, y left, z up. Azimuths count from x to y, elevations from the horizon up. A column is what fires
together; row and column give a ray: its azimuth is that of the column and the offset of the row.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.json_tree import read_json
from sparsestreet.finite import check_finite

MAX_RAYS = 2_000_000
"""Of a turn: several times what the finest lidar has, and some hundred megabytes while they are drawn."""
MAX_SECONDS = 10.0
"""A turn lasts."""


@dataclass(frozen=True)
class LidarModel:
    """A spinning lidar by its tables. Raises ValueError for tables that no lidar has."""

    name: str
    row_elevations: Float64[Tensor, " r"]
    """Radians."""
    row_offsets: Float64[Tensor, " r"]
    """Radians of azimuth that a row adds to that of its column."""
    column_azimuths: Float64[Tensor, " c"]
    """Radians, in the order in which they are fired: they rise or fall all the way, and go around at most once."""
    seconds: float
    """From the first column to that of the next turn; columns are fired evenly."""
    reach: float
    """Meters beyond which nothing returns; infinite: not known."""
    source: str
    """Where the tables are from."""

    def __post_init__(self) -> None:
        rows, columns = len(self.row_elevations), len(self.column_azimuths)
        if not 1 <= rows * columns <= MAX_RAYS:
            raise ValueError(f"a lidar has 1 to {MAX_RAYS:,} rays, got {rows} rows and {columns} columns: take fewer")
        tables = {name: getattr(self, name) for name in ("row_elevations", "row_offsets", "column_azimuths")}
        check_finite(tables, "write radians")
        if (most := float(self.row_elevations.abs().max())) > math.pi / 2:
            raise ValueError(f"elevations lie within pi/2, got {most:g}: write radians")
        if not 0 < self.seconds <= MAX_SECONDS:
            raise ValueError(f"a turn takes more than 0 and at most {MAX_SECONDS:g} s, got {self.seconds:g}")
        if not self.reach > 0:
            raise ValueError(f"reach must be above 0 m, got {self.reach:g}: leave it out where it is not known")
        steps = self._steps
        if not ((steps > 0).all() or (steps < 0).all()) or float(steps.abs().sum()) >= 2 * math.pi:
            raise ValueError("azimuths of columns rise or fall all the way, at most once around: order them as fired")

    @property
    def _steps(self) -> Float64[Tensor, " s"]:
        """The shorter way from each column to the next, radians."""
        return torch.remainder(self.column_azimuths.diff() + math.pi, 2 * math.pi) - math.pi

    @property
    def is_clockwise(self) -> bool:
        """Whether it turns from y to x, seen from above."""
        return bool((self._steps < 0).all())

    def directions(self) -> Float64[Tensor, "n 3"]:
        """Return the unit vectors of all rays as they are fired: column by column, in it row by row."""
        azimuths = (self.column_azimuths[:, None] + self.row_offsets).flatten()
        elevations = self.row_elevations.repeat(len(self.column_azimuths))
        flat = elevations.cos()
        return torch.stack((flat * azimuths.cos(), flat * azimuths.sin(), elevations.sin()), -1)

    def shares(self) -> Float64[Tensor, " n"]:
        """Return when each ray is fired, in [0, 1) of a turn."""
        columns = len(self.column_azimuths)
        return (torch.arange(columns).double() / columns).repeat_interleave(len(self.row_elevations))


def lidar_model(said: str) -> LidarModel:
    """Return the lidar of a name, or of a .json with the keys of ncore's spinning lidars.

    Raises LogError for a file that has no such tables, ValueError for a name that no lidar has here.
    """
    if said.endswith(".json"):
        return _read_model(Path(said).expanduser())
    if said not in NAMES:
        raise ValueError(f"there is no lidar {said[:60]!r}: name {', '.join(NAMES)}, or a .json of its angles")
    return NAMES[said]()


_KEYS = ("row_elevations_rad", "column_azimuths_rad", "row_azimuth_offsets_rad", "spinning_direction")
_KEYS += ("spinning_frequency_hz", "n_rows", "n_columns", "reach_m")


def _read_model(path: Path) -> LidarModel:
    """Read ``row_elevations_rad``, ``column_azimuths_rad`` and so on; ``reach_m`` is ours and may be missing."""
    said = read_json(path).only(*_KEYS)
    elevations, azimuths = said["row_elevations_rad"].numbers(), said["column_azimuths_rad"].numbers()
    offsets = said["row_azimuth_offsets_rad"].numbers(len(elevations))
    for key, count in (("n_rows", len(elevations)), ("n_columns", len(azimuths))):
        if (counted := said.get(key)) is not None:
            counted.whole(count, count)
    rows, beside, columns = (torch.tensor(one, dtype=torch.float64) for one in (elevations, offsets, azimuths))
    seconds, reach = 1 / said["spinning_frequency_hz"].number(positive=True), said.get("reach_m")
    far = math.inf if reach is None else reach.number(positive=True)
    try:
        model = LidarModel(path.stem, rows, beside, columns, seconds, far, str(path))
    except ValueError as error:
        raise said.fault(f"is no lidar: {error}", "write the tables of the sensor") from error
    turns = said["spinning_direction"]
    if turns.text() != ("cw" if model.is_clockwise else "ccw"):
        raise turns.fault(f"is {turns.text()[:20]!r}, against the order of column_azimuths_rad", "write cw or ccw")
    return model


def _spinning(
    name: str,
    elevations: list[float],
    columns: int,
    *,
    first: float,
    step: float,
    reach: float,
    source: str,
    offsets: list[float] | None = None,
    hertz: float = 10.0,
) -> LidarModel:
    """Make a model from degrees."""
    rows, beside = (
        torch.tensor(one, dtype=torch.float64).deg2rad() for one in (elevations, offsets or [0.0] * len(elevations))
    )
    azimuths = (first + step * torch.arange(columns, dtype=torch.float64)).deg2rad()
    return LidarModel(name, rows, beside, azimuths, 1 / hertz, reach, source)


def _degrees(text: str) -> list[float]:
    return [float(one) for one in text.split()]


_NCORE = "github.com/NVIDIA/ncore, commit 77144a9, ncore/impl/sensors/test_data (Apache-2.0)"
_WAYMO = """
    2.2053 2.0452 1.8508 1.6846 1.5223 1.3629 1.1964 1.0328 0.8363 0.6863 0.5149 0.3536 0.1886 0.0315 -0.1536
    -0.3123 -0.4862 -0.6374 -0.8126 -0.9633 -1.1546 -1.3143 -1.4838 -1.658 -1.8457 -2.0362 -2.2698 -2.4838 -2.7181
    -2.9624 -3.2113 -3.4711 -3.7916 -4.0534 -4.3738 -4.6751 -4.9959 -5.314 -5.6868 -6.0512 -6.4189 -6.778 -7.1808
    -7.5672 -7.986 -8.4122 -8.8387 -9.2686 -9.7248 -10.1727 -10.6574 -11.1311 -11.6233 -12.1108 -12.6573 -13.1694
    -13.7124 -14.2423 -14.7873 -15.329 -15.9214 -16.5117 -17.118 -17.7191
"""
_PANDAR64 = """
    14.87 11.02 8.047 5.045 3.028 2.016 1.848 1.676 1.51 1.339 1.172 1.001 0.834 0.663 0.496 0.325 0.157 -0.012
    -0.181 -0.349 -0.52 -0.687 -0.857 -1.025 -1.196 -1.363 -1.534 -1.7 -1.872 -2.04 -2.21 -2.377 -2.548 -2.712
    -2.885 -3.052 -3.222 -3.387 -3.56 -3.724 -3.896 -4.062 -4.233 -4.397 -4.57 -4.732 -4.904 -5.069 -5.241 -5.403
    -5.577 -5.738 -5.91 -6.073 -7.075 -8.071 -9.072 -9.897 -11.044 -12.018 -12.986 -13.942 -18.901 -24.909
"""
_PANDAR64_OFFSETS = [1.042] * 5 + [1.042, -1.042, -3.125, -5.208, 5.208, 3.125] * 8 + [1.042] * 11
_AT128_OFFSETS = """
    0 0.001 2.209 -0.001 2.195 0.001 2.197 0 2.199 -0.012 2.203 -0.006 2.203 0.008 2.206 4.398 2.208 4.405 6.636
    4.405 6.629 4.407 6.629 4.4 6.629 4.412 -4.449 -2.269 -0.002 6.634 2.223 8.81 11.002 4.412 -4.461 -2.26 -0.016
    6.629 2.216 8.812 11.016 4.418 -4.465 -2.262 -0.016 6.616 2.213 8.817 11.022 4.419 -4.478 -2.275 -0.021 6.62
    2.208 8.815 11.032 4.415 -4.488 -2.293 -0.031 6.618 2.202 8.826 11.046 4.423 -4.498 -2.3 -0.033 6.625 2.207
    8.83 11.054 4.421 -4.513 -2.303 -0.036 6.635 2.201 8.843 11.061 4.428 -4.526 -2.314 -0.05 6.635 2.202 8.857
    11.08 4.427 6.635 4.429 6.643 4.432 6.641 -0.092 6.65 -0.104 2.185 -0.117 2.173 -0.124 2.169 -0.136 2.155
    -0.145 2.149 -0.15 2.139 -0.167 2.131 4.416 2.132 4.403 6.683 4.398 6.683 4.4 6.683 4.393 6.687 4.391 6.694
    4.388 6.7 4.377 6.691 6.706
"""


@cache
def _waymo_top() -> LidarModel:
    return _spinning(
        "waymo_top", _degrees(_WAYMO), 2650, first=31.96163, step=-360 / 2650, reach=75.0, source=f"{_NCORE}, waymo"
    )


@cache
def _pandar64() -> LidarModel:
    return _spinning(
        "pandar64",
        _degrees(_PANDAR64),
        1800,
        first=179.95,
        step=-0.2,
        offsets=_PANDAR64_OFFSETS,
        reach=200.0,
        source=f"{_NCORE}, pandaset",
    )


@cache
def _at128() -> LidarModel:
    return _spinning(
        "at128",
        [12.93 - 0.2 * row for row in range(128)],
        1200,
        first=60.0,
        step=-120 / 1199,
        offsets=_degrees(_AT128_OFFSETS),
        reach=200.0,
        source=f"{_NCORE}, hesai-at128",
    )


@cache
def _hdl64() -> LidarModel:
    upper, lower = [2 - row / 3 for row in range(32)], [-8.83 - row / 2 for row in range(32)]
    return _spinning(
        "hdl64",
        upper + lower,
        2083,
        first=180.0,
        step=-360 / 2083,
        reach=120.0,
        source="Velodyne HDL-64E, nominal: rows of a KITTI sweep lie 0.3 to 0.8 degrees higher",
    )


@cache
def _hdl32() -> LidarModel:
    return _spinning(
        "hdl32",
        [10.67 - 4 / 3 * row for row in range(32)],
        1085,
        first=180.0,
        step=-360 / 1085,
        reach=100.0,
        source="Velodyne HDL-32E, nominal: rows of a nuScenes sweep above -20 degrees lie within 0.1 degrees, at 20 Hz",
        hertz=20.0,
    )


NAMES: dict[str, Callable[[], LidarModel]] = {
    "waymo_top": _waymo_top,
    "hdl64": _hdl64,
    "hdl32": _hdl32,
    "pandar64": _pandar64,
    "at128": _at128,
}
"""Name of a lidar -> what makes its tables."""
