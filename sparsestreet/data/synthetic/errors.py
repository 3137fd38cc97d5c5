"""Errors of poses in the street's files: what they say is off, and images and lidar are not."""

import numpy as np
from scipy.spatial.transform import Rotation

from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import StreetSettings


def noisy_camera(settings: StreetSettings, world_from_camera: Pose, frame: int, camera: int) -> Pose:
    """Returns the pose that the files say an image has: the true one and a random rigid motion of its own."""
    if not settings.pose_noise:
        return world_from_camera
    meters, degrees = settings.pose_noise
    drawn = stream(settings.seed, f"pose of {frame} {camera}").standard_normal((2, 3)) / np.sqrt(3)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * drawn[0]).as_matrix()
    motion[:3, 3] = meters * drawn[1]
    return world_from_camera @ motion


def noisy_box(settings: StreetSettings, world_from_object: Pose, name: str, frame: int) -> Pose:
    """Returns the pose that the files say a box has. It stays upright, as people draw boxes."""
    if not settings.box_noise:
        return world_from_object
    meters, degrees = settings.box_noise
    turn, *shift = stream(settings.seed, f"box of {name} {frame}").standard_normal(4)
    x, y, z = (meters * float(value) / np.sqrt(3) for value in shift)
    return world_from_object @ at(x, y, z, float(np.radians(degrees) * turn))
