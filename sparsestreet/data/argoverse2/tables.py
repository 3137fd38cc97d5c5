"""The tables of a log: the vehicle's path, the cameras, the boxes, and the points of a sweep."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.argoverse2.feather import read_columns
from sparsestreet.data.argoverse2.layout import Layout
from sparsestreet.data.lidar import check_points, returned
from sparsestreet.data.motion import PosePath
from sparsestreet.data.poses import rigid_poses
from sparsestreet.data.problems import fault
from sparsestreet.data.recording import Boxes

QUATERNION, TRANSLATION, SIZE = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m"), ("length_m", "width_m", "height_m")
NEAR_DUPLICATE = 1000
"""Nanoseconds. Of poses closer together than this the first is taken: their difference is no velocity. The others lie
about 5 ms apart; in one genuine log 314 of 2,706 lie 1 to 100 ns behind another."""
LONGEST_GAP = 500_000_000
"""Nanoseconds between two poses. Over half a second the acceleration of a car (4 m/s^2) makes 12 cm."""


@dataclass(frozen=True)
class MountedCamera:
    """The calibration of one camera."""

    intrinsics: Float64[Tensor, "3 3"]
    """Pixel centers at +0.5."""
    size: tuple[int, int]
    """(width, height), pixels."""
    ego_from_camera: Float64[Tensor, "4 4"]


def read_path(layout: Layout) -> tuple[PosePath, int]:
    """The vehicle's path in the city, and how many near-duplicate poses were left out; raises LogError."""
    path = layout.poses
    table = read_columns(path, {"timestamp_ns": int} | dict.fromkeys((*QUATERNION, *TRANSLATION), float))
    stamps = table["timestamp_ns"]
    if not len(stamps):
        raise fault(path, "the table has no poses", "fetch the file again from its publisher")
    late = np.flatnonzero(np.diff(stamps) < 0)
    if len(late):
        message = f"stamps must not decrease, but row {late[0] + 1} lies before row {late[0]}"
        raise fault(path, message, "sort the rows by timestamp_ns")
    kept = np.flatnonzero(np.diff(stamps, prepend=stamps[0] - LONGEST_GAP) > NEAR_DUPLICATE)
    gaps = np.diff(stamps[kept])
    if len(gaps) and gaps.max() > LONGEST_GAP:
        message = f"{gaps.max() / 1e9:.2f} s lie between two poses, at most {LONGEST_GAP / 1e9:g} s can be interpolated"
        raise fault(path, message, "fetch the file again from its publisher")
    poses = rigid_poses(_rows(table, QUATERNION), _rows(table, TRANSLATION), path, "row")
    return PosePath(torch.from_numpy(stamps[kept]), poses[torch.from_numpy(kept)]), len(stamps) - len(kept)


def read_cameras(layout: Layout) -> dict[str, MountedCamera]:
    """Every camera that is calibrated, by name; raises LogError.

    The lens k1, k2, k3 is passed over: images are shipped without it (av2-api, issues 219 and 226). Pixels of the
    calibration have their centers at whole numbers, ours at +0.5.
    """
    kinds = {"sensor_name": str, "width_px": int, "height_px": int} | dict.fromkeys(("fx_px", "fy_px"), float)
    table = read_columns(layout.intrinsics, kinds | dict.fromkeys(("cx_px", "cy_px"), float))
    mounts = read_columns(layout.mounts, {"sensor_name": str} | dict.fromkeys((*QUATERNION, *TRANSLATION), float))
    poses = rigid_poses(_rows(mounts, QUATERNION), _rows(mounts, TRANSLATION), layout.mounts, "row")
    cameras = {}
    for row, name in enumerate(table["sensor_name"]):
        numbers = [float(table[column][row]) for column in ("fx_px", "fy_px", "cx_px", "cy_px")]
        width, height = int(table["width_px"][row]), int(table["height_px"][row])
        if not np.isfinite(numbers).all() or min(numbers) <= 0 or min(width, height) <= 0:
            message = f"{name} has fx, fy, cx, cy = {numbers} and {width} x {height} pixels, which must be positive"
            raise fault(layout.intrinsics, message, "fetch the file again from its publisher")
        fx, fy, cx, cy = numbers
        matrix = torch.tensor([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = MountedCamera(matrix, (width, height), _mount(layout, mounts["sensor_name"], poses, name))
    return cameras


def _mount(layout: Layout, names: np.ndarray, poses: Float64[Tensor, "n 4 4"], name: str) -> Float64[Tensor, "4 4"]:
    rows = np.flatnonzero(names == name)
    if len(rows) != 1:
        message = f"{name} has {len(rows)} rows, a camera has one"
        raise fault(layout.mounts, message, "fetch the file again from its publisher")
    return poses[int(rows[0])]


def read_boxes(
    layout: Layout, sweeps: Sequence[int], frames: Mapping[int, int], path: PosePath
) -> tuple[list[Boxes], int]:
    """Objects with a box at one of the instants, and how many boxes of the log have no sweep; raises LogError.

    Args:
        layout: the log.
        sweeps: stamps of all sweeps of the log.
        frames: stamp of a sweep that is read -> its instant.
        path: of the vehicle; boxes lie in its frame at the stamp of their sweep.
    """
    file = layout.boxes
    kinds = {"timestamp_ns": int, "track_uuid": str, "category": str}
    table = read_columns(file, kinds | dict.fromkeys((*SIZE, *QUATERNION, *TRANSLATION), float))
    stamps, names = table["timestamp_ns"], table["track_uuid"]
    poses = rigid_poses(_rows(table, QUATERNION), _rows(table, TRANSLATION), file, "row")
    rows = np.flatnonzero(np.isin(stamps, np.array(list(frames), dtype=np.int64)))
    # One object behind the other, each in order of time.
    rows = rows[np.lexsort((stamps[rows], names[rows].astype(str)))]
    starts = np.flatnonzero(names[rows][1:] != names[rows][:-1]) + 1
    objects = [_boxes(table, one, poses, frames, path, file) for one in np.split(rows, starts) if len(one)]
    return objects, int((~np.isin(stamps, np.array(sweeps, dtype=np.int64))).sum())


def _boxes(
    table: Mapping[str, np.ndarray],
    rows: np.ndarray,
    ego_from_box: Float64[Tensor, "n 4 4"],
    frames: Mapping[int, int],
    path: PosePath,
    file: Path,
) -> Boxes:
    """One object, of whose boxes the rows are."""
    name, stamps = str(table["track_uuid"][rows[0]]), table["timestamp_ns"][rows]
    if (twins := np.flatnonzero(np.diff(stamps) == 0)).size:
        raise fault(file, f"object {name} has two boxes at {stamps[twins[0]]}", "keep one box of an object at a time")
    return Boxes(
        name=name,
        class_name=str(table["category"][rows[0]]),
        frames=np.array([frames[int(stamp)] for stamp in stamps]),
        poses=(path.at(torch.from_numpy(stamps)) @ ego_from_box[torch.from_numpy(rows)]).numpy(),
        sizes=_rows(table, SIZE).numpy()[rows],
        path=file,
        stamps=tuple(map(int, stamps)),
    )


def read_sweep(path: Path, city_from_ego: Float64[Tensor, "4 4"]) -> Float64[Tensor, "n 3"]:
    """Points in the city, meters; raises LogError.

    They are stored in float16, in the vehicle's frame at the stamp of the sweep, both lidars together and the vehicle's
    motion taken out.
    """
    points = read_points(path)
    points = points[returned(points)]
    return points @ city_from_ego[:3, :3].T + city_from_ego[:3, 3]


def read_points(path: Path) -> Float64[Tensor, "n 3"]:
    """Points in the vehicle's frame, as ``read_sweep`` finds them."""
    points = _rows(read_columns(path, dict.fromkeys(("x", "y", "z"), float)), ("x", "y", "z"))
    check_points(points, path)
    return points


def _rows(table: Mapping[str, np.ndarray], columns: Sequence[str]) -> Float64[Tensor, "n _"]:
    return torch.from_numpy(np.stack([table[name] for name in columns], -1))
