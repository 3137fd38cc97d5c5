"""Where a camera was while its image was read out.

The files give, for an image, the vehicle's pose at an instant near by and its velocity. With p, R of the pose, v the
linear velocity along the world's axes and w the angular one about the vehicle's, it was dt later at

    p(dt) = p + v dt,    R(dt) = R exp(w dt).
"""

from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.poses import AHEAD_FROM_OPENCV
from sparsestreet.data.waymo.segment import CameraCalibration, ImageMotion
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import Shutter

_PER_SECOND = 1_000_000_000
SIDES: dict[int, Literal["top", "left", "bottom", "right"]] = {1: "top", 2: "left", 3: "bottom", 4: "right"}
"""Side of the image that is read first."""


def nanoseconds(seconds: float) -> int:
    """Exact: a product would round a double of 1.5e9 seconds once more."""
    whole = int(seconds)
    return whole * _PER_SECOND + round((seconds - whole) * _PER_SECOND)


def middle(motion: ImageMotion) -> int:
    """Nanoseconds at the middle of exposure and readout."""
    return (nanoseconds(motion.trigger) + nanoseconds(motion.readout_done)) // 2


def readout(motion: ImageMotion) -> int:
    """Nanoseconds from the first row or column to the last; what is left of the time is its exposure."""
    spent = nanoseconds(motion.readout_done) - nanoseconds(motion.trigger)
    return max(spent - round(motion.exposure * _PER_SECOND), 0)


def vehicle_at(motion: ImageMotion, stamp: int) -> Float64[Tensor, "4 4"]:
    """world_from_vehicle at an instant (nanoseconds) near the image's."""
    later = (stamp - nanoseconds(motion.pose_time)) / _PER_SECOND
    pose = motion.world_from_vehicle.clone()
    pose[:3, :3] = pose[:3, :3] @ quat.to_matrix(quat.from_rotation_vector(later * motion.angular))
    pose[:3, 3] += later * motion.linear
    return pose


def camera_at(motion: ImageMotion, camera: CameraCalibration, stamp: int) -> Float64[Tensor, "4 4"]:
    """world_from_camera with OpenCV's axes."""
    return vehicle_at(motion, stamp) @ camera.vehicle_from_camera @ AHEAD_FROM_OPENCV


def shutter(motion: ImageMotion, camera: CameraCalibration) -> Shutter | None:
    """The camera's motion while its image is read out; None where all pixels are read at once, or no order is known."""
    if camera.direction not in SIDES:
        return None
    duration = readout(motion) / _PER_SECOND
    vehicle, pose = vehicle_at(motion, middle(motion)), camera_at(motion, camera, middle(motion))
    # A mount turns with the vehicle: its own velocity is v + R (w x t).
    lever = vehicle[:3, :3] @ torch.linalg.cross(motion.angular, camera.vehicle_from_camera[:3, 3])
    camera_from_world = pose[:3, :3].T
    translation = camera_from_world @ (motion.linear + lever) * duration
    rotation = camera_from_world @ vehicle[:3, :3] @ motion.angular * duration
    return Shutter(translation.float(), rotation.float(), SIDES[camera.direction], duration)
