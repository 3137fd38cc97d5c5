"""Poses of a sequence, which exist for frames at which the car had moved, and its calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.kitti.calibration import RectifiedCamera, rectified_camera, rectifying_rotation, rigid
from sparsestreet.data.kitti.text import keyed_numbers, numbers, read_keyed, read_lines
from sparsestreet.data.kitti360.fisheye import FisheyeCamera, read_fisheye
from sparsestreet.data.kitti360.layout import FISHEYE
from sparsestreet.data.poses import check_rigid
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.geometry.cameras import inverse

_REMEDY = "copy it again from the published archive"


@dataclass(frozen=True)
class Calibration360:
    imu_from_lidar: Float64[Tensor, "4 4"]
    """The IMU has x forward, y right, z down; the lidar x forward, y left, z up."""
    imu_from_camera: Mapping[str, Float64[Tensor, "4 4"]]
    """After rectification."""
    cameras: Mapping[str, RectifiedCamera | FisheyeCamera]


def read_poses(path: Path) -> dict[int, Float64[Tensor, "4 4"]]:
    """Frame -> world_from_imu; raises LogError for lines that are no frame with a 3x4 matrix, or out of order.

    Whether the matrices are rigid is asked of those that are used (``check_pose``).
    """
    poses: dict[int, Float64[Tensor, "4 4"]] = {}
    last = -1
    for line_number, line in enumerate(read_lines(path), 1):
        if not line:
            continue
        row = numbers(line.split(), path, f"line {line_number}")
        if len(row) != 13:
            raise fault(path, f"line {line_number} has {len(row)} numbers, not a frame and a 3x4 matrix", _REMEDY)
        if row[0] % 1 or not last < row[0] < 1e9:
            message = f"line {line_number} is of frame {row[0]:g}, which does not follow frame {last}"
            raise fault(path, message, _REMEDY)
        last = int(row[0])
        poses[last] = torch.eye(4, dtype=torch.float64)
        poses[last][:3] = torch.from_numpy(row[1:].reshape(3, 4))
    if not poses:
        raise fault(path, "the file holds no poses", _REMEDY)
    return poses


def check_pose(pose: Float64[Tensor, "4 4"], frame: int, path: Path) -> None:
    """Raises LogError unless the pose is rigid."""
    check_rigid(pose, path, f"the pose of frame {frame}")


def read_calibration(folder: Path, cameras: Sequence[str]) -> Calibration360:
    """Raises LogError with all that is wrong in the files.

    imu_from_camera = cam_to_pose R_rect^-1: the files place the cameras as they are before rectification. Fisheyes stay
    as they are.
    """
    problems: list[Problem] = []
    places, lidar = folder / "calib_cam_to_pose.txt", folder / "calib_cam_to_velo.txt"
    mounts = attempt(problems, lambda: read_keyed(places)) or {}
    found: dict[str, RectifiedCamera | FisheyeCamera] = {}
    imu_from_camera = {}
    for name in cameras if mounts else ():
        camera = attempt(problems, partial(_camera, folder, name))
        mount = attempt(problems, partial(_mount, mounts, name, places))
        if camera is not None and mount is not None:
            found[name], turn = camera
            imu_from_camera[name] = mount @ inverse(turn)
    lidar_from_first = attempt(problems, partial(_single, lidar))
    first = attempt(problems, partial(_mount, mounts, "image_00", places)) if mounts else None
    if problems or lidar_from_first is None or first is None:
        raise LogError(list(dict.fromkeys(problems)))
    return Calibration360(first @ inverse(lidar_from_first), imu_from_camera, found)


def _camera(folder: Path, name: str) -> tuple[RectifiedCamera | FisheyeCamera, Float64[Tensor, "4 4"]]:
    """A camera and the rotation that rectified it."""
    if name in FISHEYE:
        return read_fisheye(folder / f"{name}.yaml"), torch.eye(4, dtype=torch.float64)
    path = folder / "perspective.txt"
    table = read_keyed(path)
    return rectified_camera(table, name[-2:], path), rectifying_rotation(table, name[-2:], path)


def _mount(table: Mapping[str, str], name: str, path: Path) -> Float64[Tensor, "4 4"]:
    matrix = keyed_numbers(table, name, (3, 4), path)
    return rigid(matrix[:, :3], matrix[:, 3], path, name)


def _single(path: Path) -> Float64[Tensor, "4 4"]:
    """A file of one 3x4 matrix, without a key."""
    found = numbers(" ".join(read_lines(path)).split(), path, "the file")
    if found.shape != (12,):
        raise fault(path, f"the file has {len(found)} numbers, not the 12 of a 3x4 matrix", _REMEDY)
    matrix: np.ndarray = found.reshape(3, 4)
    return rigid(matrix[:, :3], matrix[:, 3], path, "the matrix")
