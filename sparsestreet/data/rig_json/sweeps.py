"""Lidar points from .bin, .npy and .ply files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.lidar import check_points, returned
from sparsestreet.data.motion import PosePath, untwisted
from sparsestreet.data.ply import read_ply
from sparsestreet.data.problems import fault
from sparsestreet.data.rig_json.table import FrameEntry, LidarEntry
from sparsestreet.geometry.cameras import transform_points

_BIN = ("x", "y", "z", "intensity")
_LONGEST_SWEEP = 1.0
"""Seconds around its stamp in which a point may have been measured."""


def read_sweep(
    path: Path, frame: FrameEntry, lidar: LidarEntry, drive: PosePath | None, reference: Float64[Tensor, "3"]
) -> Float64[Tensor, "n 3"]:
    """Points in the world.

    Args:
        path: the file.
        frame: whose sweep it is.
        lidar: how it is written.
        drive: world_from_vehicle over time; None: without a clock.
        reference: a place near the lidar, in the world.

    Raises LogError for a file that is missing or holds anything else.
    """
    points, times = read_rows(path, lidar.columns)
    # Who writes the world's points moves a driver's zeros to the sensor, or leaves them.
    some = returned(points)
    points, times = points[some], None if times is None else times[some]
    mount = lidar.vehicle_from_lidar
    check_points(points - reference if mount is None else points, path)
    center = reference if mount is None else torch.zeros(3, dtype=torch.float64)
    far = ((points - center).norm(dim=-1) >= lidar.nearest) & returned(points - center)
    points = points[far]
    if mount is None:
        return points
    points = transform_points(mount, points)
    stamp = frame.stamp if frame.sweep_stamp is None else frame.sweep_stamp
    if stamp is None or drive is None:
        assert frame.world_from_vehicle is not None  # the reader has looked
        return transform_points(frame.world_from_vehicle, points)
    try:
        if times is None:
            return transform_points(drive.at(torch.tensor([stamp]))[0], points)
        return untwisted(points, stamp + (1e9 * times[far]).round().long(), drive)
    except ValueError as error:
        raise fault(path, str(error), "leave out what was measured outside of the drive") from error


def read_rows(
    path: Path, columns: tuple[str, ...] | None
) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, " n"] | None]:
    """Points as they are written, and their seconds behind the stamp of the sweep where ``columns`` have a time."""
    if path.suffix == ".ply":
        return read_ply(path)[0], None
    if path.suffix not in (".bin", ".npy"):
        raise fault(path, f"points of the ending {path.suffix!r} are not read", "write .bin, .npy or .ply")
    rows = _binary(path, columns or _BIN) if path.suffix == ".bin" else _array(path, columns)
    names = columns or _BIN[:3]
    points = np.stack([rows[:, names.index(axis)] for axis in "xyz"], 1).astype(np.float64)
    if "time" not in names:
        return torch.from_numpy(points), None
    times = torch.from_numpy(rows[:, names.index("time")].astype(np.float64))
    if not (times.abs() <= _LONGEST_SWEEP).all():
        message = f"times must lie within {_LONGEST_SWEEP:g} s of the sweep's stamp"
        raise fault(path, message, "write seconds behind the stamp")
    return torch.from_numpy(points), times


def _binary(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or leave out the frame's lidar")
    if path.stat().st_size % (4 * len(columns)):
        message = f"{path.stat().st_size} bytes are no whole number of rows of {len(columns)} float32"
        raise fault(path, message, f"write rows of {', '.join(columns)}, or name the columns in lidar.columns")
    check_regular(path)
    return np.fromfile(path, dtype="<f4").reshape(-1, len(columns))


def _array(path: Path, columns: tuple[str, ...] | None) -> np.ndarray:
    """Mapped, so that a header cannot ask for memory that the file does not fill."""
    try:
        rows = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy's parser of headers raises whatever Python's own does
        raise fault(path, f"the file is no array ({str(error)[:80]})", "write it by numpy.save") from error
    wanted = "at least 3" if columns is None else str(len(columns))
    fits = rows.ndim == 2 and (rows.shape[1] >= 3 if columns is None else rows.shape[1] == len(columns))
    if not fits or rows.dtype.kind not in "fiu":
        message = f"the array is {rows.dtype} of {rows.shape}, not numbers in rows of {wanted}"
        raise fault(path, message, "write a row a point: x, y, z and whatever lidar.columns names")
    return rows
