"""Cameras of viser's windows as poses, and back."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sparsestreet.viewing.stage import Eye

_LARGEST = 16_384
"""Pixels of a side of a window."""


def eye_of(camera: Any) -> Eye | None:
    """Where a window of viser looks from; its axes are OpenCV's, its field of view vertical.

    None where it has no size, as in a tab that nobody sees, or says what no camera is: anybody may write to a server.
    """
    numbers = np.array([*camera.wxyz, *camera.position, camera.fov], np.float64)
    width, height = int(camera.image_width), int(camera.image_height)
    if not np.isfinite(numbers).all() or not np.linalg.norm(numbers[:4]) > 0:
        return None
    if not (0 < numbers[7] < math.pi and 0 < width <= _LARGEST and 0 < height <= _LARGEST):
        return None
    return Eye(matrix(numbers[:4], numbers[4:7]), float(numbers[7]), width, height)


def show_from(client: Any, eye: Eye) -> None:
    """Let a window of viser look from there."""
    with client.atomic():
        client.camera.position = eye.world_from_camera[:3, 3]
        client.camera.wxyz = wxyz_of(eye.world_from_camera)
        client.camera.fov = eye.fov


def matrix(wxyz: Any, position: Any) -> Float64[np.ndarray, "4 4"]:
    """A pose of a unit quaternion and a position, meters.

    >>> matrix((1.0, 0.0, 0.0, 0.0), (1.0, 2.0, 3.0))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(wxyz, np.float64), scalar_first=True).as_matrix()
    pose[:3, 3] = position
    return pose


def wxyz_of(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4"]:
    """The rotation of a pose as a unit quaternion."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
