"""Rigid transforms of a data set: made of quaternions, checked, and re-centered in float64."""

from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.problems import fault
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import rigidity_error

AHEAD_FROM_OPENCV = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""Axes x ahead, y left, z up, which Waymo's cameras have too, from OpenCV's."""
RIGIDITY_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is let through: it moves a point 100 m away by 5 mm, less than lidar noise, and is a
hundred times what poses stored in float32 show."""
_LENGTH_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: one that was stored with four digits is let through, and made 1."""


def rigid_poses(
    quaternions: Float64[Tensor, "n 4"], translations: Float64[Tensor, "n 3"], path: Path, what: str
) -> Float64[Tensor, "n 4 4"]:
    """Transforms of rotations (wxyz) and translations. Raises LogError, naming the file and the first row, for numbers
    that are not finite, and quaternions that are no rotations."""
    broken = ~(torch.isfinite(quaternions).all(-1) & torch.isfinite(translations).all(-1))
    if broken.any():
        row = int(torch.nonzero(broken)[0])
        raise fault(path, f"{what} {row} holds NaN or infinity", "write the pose again, or leave it out")
    lengths = quaternions.norm(dim=-1)
    if ((lengths - 1).abs() > _LENGTH_TOLERANCE).any():
        row = int((lengths - 1).abs().argmax())
        message = f"{what} {row} has a quaternion of length {float(lengths[row]):.4g}, which is no rotation"
        raise fault(path, message, "write unit quaternions, w first")
    poses = torch.zeros(len(quaternions), 4, 4, dtype=torch.float64)
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = quat.to_matrix(quaternions), translations, 1
    return poses


def check_rigid(pose: Float64[Tensor, "4 4"], path: Path, what: str) -> None:
    """Raises LogError unless the matrix is finite and a rotation and translation."""
    if not torch.isfinite(pose).all():
        raise fault(path, f"{what} holds NaN or infinity", "write the pose again, or leave its frame out")
    error = rigidity_error(pose)
    if error > RIGIDITY_TOLERANCE:
        message = f"{what} is no rigid transform: R^T R, det R or the last row is off by {error:.2g}"
        raise fault(path, message, f"write a rotation and a translation in meters, to {RIGIDITY_TOLERANCE:g} or better")


def are_rigid(poses: Float64[Tensor, "n 4 4"]) -> bool:
    """Whether ``check_rigid`` would let all of them through, without a look at each."""
    rotations = poses[:, :3, :3]
    gram = (rotations.mT @ rotations - torch.eye(3, dtype=poses.dtype)).abs()
    last = (poses[:, 3] - torch.tensor([0, 0, 0, 1], dtype=poses.dtype)).abs()
    # A NaN compares false.
    near = bool((gram <= RIGIDITY_TOLERANCE).all() & (last <= RIGIDITY_TOLERANCE).all())
    return near and bool(torch.isfinite(poses).all() & (torch.linalg.det(rotations) > 0).all())


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
