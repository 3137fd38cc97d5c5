"""Rigid transforms of a data set: checked, and re-centered in float64."""

from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.problems import fault
from sparsestreet.geometry.transforms import rigidity_error

RIGIDITY_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is let through: it moves a point 100 m away by 5 mm, less than lidar noise, and is a
hundred times what poses stored in float32 show."""


def check_rigid(pose: Float64[Tensor, "4 4"], path: Path, what: str) -> None:
    """Raises LogError unless the matrix is finite and a rotation and translation."""
    if not torch.isfinite(pose).all():
        raise fault(path, f"{what} holds NaN or infinity", "write the pose again, or leave its frame out")
    error = rigidity_error(pose)
    if error > RIGIDITY_TOLERANCE:
        message = f"{what} is no rigid transform: R^T R, det R or the last row is off by {error:.2g}"
        raise fault(path, message, f"write a rotation and a translation in meters, to {RIGIDITY_TOLERANCE:g} or better")


def recentered(pose: Float64[Tensor, "*b 4 4"], origin: Float64[Tensor, "3"]) -> Float64[Tensor, "*b 4 4"]:
    """Poses of a data set's world in the log's, whose origin is at ``origin``; the axes are kept."""
    pose = pose.clone()
    pose[..., :3, 3] -= origin
    return pose


def dataset_from_world(origin: Float64[Tensor, "3"]) -> Float64[Tensor, "4 4"]:
    """What undoes ``recentered``."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, 3] = origin
    return transform
