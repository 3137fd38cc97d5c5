"""Poses and intrinsics from text files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.problems import fault
from sparsestreet.geometry.transforms import rigidity_error

RIGIDITY_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is let through: it moves a point 100 m away by 5 mm, less than lidar noise, and is a
hundred times what poses stored in float32 show."""

# Waymo's cameras look along x, with y to the left and z up.
WAYMO_FROM_OPENCV = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)


def read_pose(path: Path) -> Float64[Tensor, "4 4"]:
    """A rigid transform; raises LogError where the file holds anything else."""
    pose = torch.from_numpy(_read_numbers(path))
    if pose.shape != (4, 4):
        raise fault(path, f"a pose is a 4x4 matrix, this is {tuple(pose.shape)}", "write four rows of four numbers")
    check_rigid(pose, path, "the matrix")
    return pose


def check_rigid(pose: Float64[Tensor, "4 4"], path: Path, what: str) -> None:
    """Raises LogError unless the matrix is finite and a rotation and translation."""
    if not torch.isfinite(pose).all():
        raise fault(path, f"{what} holds NaN or infinity", "write the pose again, or leave its frame out")
    error = rigidity_error(pose)
    if error > RIGIDITY_TOLERANCE:
        message = f"{what} is no rigid transform: R^T R, det R or the last row is off by {error:.2g}"
        raise fault(path, message, f"write a rotation and a translation in meters, to {RIGIDITY_TOLERANCE:g} or better")


def read_intrinsics(path: Path) -> tuple[Float64[Tensor, "3 3"], Float64[Tensor, "5"]]:
    """The camera matrix in pixels of the full image and the distortion k1, k2, p1, p2, k3; raises LogError."""
    numbers = torch.from_numpy(_read_numbers(path)).flatten()
    if numbers.shape != (9,):
        message = f"a camera has 9 numbers (fx fy cx cy k1 k2 p1 p2 k3), this file has {numbers.shape[0]}"
        raise fault(path, message, "write them one a line; zeros for a camera without distortion")
    if not torch.isfinite(numbers).all() or not (numbers[:4] > 0).all():
        message = f"fx, fy, cx, cy must be positive pixels, they are {numbers[:4].tolist()}"
        raise fault(path, message, "write the calibration of the full-size images")
    fx, fy, cx, cy = numbers[:4].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64), numbers[4:]


def world_from_camera(layout: Layout, frame: int, camera: int) -> Float64[Tensor, "4 4"]:
    """Pose of a camera (OpenCV axes) in the data set's world; raises LogError."""
    extrinsics = read_pose(layout.extrinsics(frame, camera))
    if not layout.waymo:
        return extrinsics
    return read_pose(layout.sweep_pose(frame)) @ extrinsics @ WAYMO_FROM_OPENCV


def world_origin(layout: Layout) -> Float64[Tensor, "3"]:
    """The point of the data set's world that the log is re-centered on; the axes are kept.

    Position of the vehicle (Waymo) or the front camera (nuScenes) at the first frame read.
    """
    first = layout.frames[0]
    path = layout.sweep_pose(first) if layout.waymo else layout.extrinsics(first, layout.front)
    return read_pose(path)[:3, 3]


def _read_numbers(path: Path) -> Float64[np.ndarray, "rows columns"]:
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or leave out its frame or camera")
    try:
        rows = [[float(number) for number in line.split()] for line in path.read_text().splitlines() if line.strip()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 0)
    except ValueError as error:
        raise fault(path, f"the file is no table of numbers ({error})", "write numbers separated by spaces") from error
