"""Calibration of a date: where lidar and cameras sit on the car, and their rectified images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.kitti.text import keyed_numbers, read_keyed
from sparsestreet.data.poses import check_rigid
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.geometry.cameras import inverse

_REMEDY = "copy the calibration of this date again from the published archive"


@dataclass(frozen=True)
class RectifiedCamera:
    """One camera after rectification: a pinhole without a lens."""

    intrinsics: Float64[Tensor, "3 3"]
    """Pixel centers at +0.5; the files count from the center of the first pixel."""
    camera_from_rectified: Float64[Tensor, "4 4"]
    """From the rectified frame of camera 0, which all four share but for their place."""
    size: tuple[int, int]
    """(width, height)."""


@dataclass(frozen=True)
class Calibration:
    imu_from_lidar: Float64[Tensor, "4 4"]
    imu_from_camera: Mapping[str, Float64[Tensor, "4 4"]]
    cameras: Mapping[str, RectifiedCamera]
    """By the name of the folder: image_00 to image_03."""


def read_calibration(folder: Path, cameras: Sequence[str]) -> Calibration:
    """Those of a date's three files; raises LogError with all that is wrong in them.

    camera_from_lidar = [I | K^-1 p] R_rect_00 velo_to_cam, where P_rect of the camera is [K | p]. The rotation is that
    of camera 0 for all cameras: the rectified frame is common.
    """
    problems: list[Problem] = []
    imu_path, lidar_path, path = (folder / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam"))
    lidar_from_imu = attempt(problems, lambda: _read_rigid(imu_path))
    camera_from_lidar = attempt(problems, lambda: _read_rigid(lidar_path))
    table = attempt(problems, lambda: read_keyed(path)) or {}
    found: dict[str, RectifiedCamera] = {}
    rotation = None
    if table:
        rotation = attempt(problems, lambda: rectifying_rotation(table, "00", path))
        for name in cameras:
            camera = attempt(problems, lambda number=name[-2:]: rectified_camera(table, number, path))
            if camera is not None:
                found[name] = camera
    if problems or lidar_from_imu is None or camera_from_lidar is None or rotation is None:
        raise LogError(problems)
    imu_from_lidar, rectified_from_lidar = inverse(lidar_from_imu), rotation @ camera_from_lidar
    places = {
        name: imu_from_lidar @ inverse(camera.camera_from_rectified @ rectified_from_lidar)
        for name, camera in found.items()
    }
    return Calibration(imu_from_lidar, places, found)


def rectified_camera(table: Mapping[str, str], number: str, path: Path) -> RectifiedCamera:
    """From the lines P_rect_XX and S_rect_XX; raises LogError."""
    projection = keyed_numbers(table, f"P_rect_{number}", (3, 4), path)
    width, height = keyed_numbers(table, f"S_rect_{number}", (2,), path)
    if not (1 <= width <= 16384 and 1 <= height <= 16384 and width % 1 == 0 and height % 1 == 0):
        raise fault(path, f"S_rect_{number} is {width:g} x {height:g}, no size of an image", _REMEDY)
    matrix = projection[:, :3]
    focal_only = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
    pinhole = not (matrix[~focal_only] - np.eye(3)[~focal_only]).any() and matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not pinhole:
        message = f"P_rect_{number} is no [K | p] of a pinhole: its left part is {matrix.tolist()}"
        raise fault(path, message, _REMEDY)
    place = torch.eye(4, dtype=torch.float64)
    # Not p_x / f as often taken: the third entry of p is 3 mm on KITTI's color cameras, and moves x by 2.3 mm too.
    place[:3, 3] = torch.from_numpy(np.linalg.solve(matrix, projection[:, 3]))
    intrinsics = torch.from_numpy(matrix.copy())
    intrinsics[:2, 2] += 0.5
    return RectifiedCamera(intrinsics, place, (int(width), int(height)))


def rectifying_rotation(table: Mapping[str, str], number: str, path: Path) -> Float64[Tensor, "4 4"]:
    """R_rect_XX as a transform; raises LogError."""
    rotation = keyed_numbers(table, f"R_rect_{number}", (3, 3), path)
    return rigid(rotation, np.zeros(3), path, f"R_rect_{number}")


def rigid(
    rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, "3"], path: Path, what: str
) -> Float64[Tensor, "4 4"]:
    """Raises LogError unless the rotation is one."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = torch.from_numpy(rotation), torch.from_numpy(translation)
    check_rigid(transform, path, what)
    return transform


def _read_rigid(path: Path) -> Float64[Tensor, "4 4"]:
    """The lines R and T."""
    table = read_keyed(path)
    return rigid(keyed_numbers(table, "R", (3, 3), path), keyed_numbers(table, "T", (3,), path), path, "[R | T]")
