"""Poses and motion of the car from the files of its GPS and IMU."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.kitti.text import numbers, read_lines
from sparsestreet.data.motion import PosePath
from sparsestreet.data.problems import fault

EARTH_RADIUS = 6378137.0
FASTEST, FASTEST_TURN = 150.0, 20.0
"""m/s and rad/s beyond which no car moves."""
_LARGEST = 1 << 16
_STEPS = 32
"""Straight parts of the arc of a sweep: at 10 m/s and 0.3 rad/s they miss it by 4 micrometers."""
_REMEDY = "copy it again from the published archive, or read other frames (data.log.first_frame, .last_frame)"


@dataclass(frozen=True)
class Oxts:
    """What the inertial system says of one frame. Its axes are x forward, y left, z up."""

    latitude: float
    """Degrees."""
    longitude: float
    altitude: float
    rotation: Float64[np.ndarray, "3 3"]
    """world_from_imu; x east, y north, z up."""
    velocity: Float64[np.ndarray, "3"]
    """m/s, in the IMU's axes."""
    turn: Float64[np.ndarray, "3"]
    """rad/s about the IMU's axes."""

    @property
    def mercator_scale(self) -> float:
        return float(np.cos(np.radians(self.latitude)))

    def world_from_imu(self, scale: float) -> Float64[Tensor, "4 4"]:
        """Mercator's projection at the scale of the drive's first frame, as the development kit has it:
        x = s r lon, y = s r ln tan(pi / 4 + lat / 2)."""
        radius = scale * EARTH_RADIUS
        north = np.log(np.tan(np.pi * (90 + self.latitude) / 360))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(self.rotation)
        pose[:3, 3] = torch.tensor([radius * np.radians(self.longitude), radius * north, self.altitude])
        return pose

    def path(self, pose: Float64[Tensor, "4 4"], stamp: int, begin: int, end: int) -> PosePath:
        """world_from_imu from ``begin`` to ``end``, where it is ``pose`` at ``stamp`` and its motion stays the same.

        The measured motion and not the neighbors' poses: the latter jump by centimeters where GPS corrects them.
        """
        twist = torch.zeros(4, 4, dtype=torch.float64)
        x, y, z = self.turn
        twist[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        twist[:3, 3] = torch.from_numpy(self.velocity)
        stamps = torch.tensor([begin + step * (end - begin) // _STEPS for step in range(_STEPS + 1)])
        seconds = (stamps - stamp).double() / 1e9
        return PosePath(stamps, pose @ torch.linalg.matrix_exp(seconds[:, None, None] * twist))


def read_oxts(path: Path) -> Oxts:
    """One frame's file of 30 numbers; raises LogError for a file that is no such thing."""
    words = " ".join(read_lines(path, _LARGEST)).split()
    if len(words) != 30:
        raise fault(path, f"a frame of GPS and IMU has 30 numbers, this file has {len(words)}", _REMEDY)
    values = numbers(words, path, "the file")
    latitude, longitude, altitude, roll, pitch, yaw, north, east, _, _, up = values[:11]
    limits = {
        "latitude": (latitude, 85.0),
        "longitude": (longitude, 360.0),
        "altitude": (altitude, 1e4),
        "angle": (np.abs(values[3:6]).max(), 2 * np.pi + 1e-6),
        "velocity": (np.abs([north, east, up]).max(), FASTEST),
        "angular rate": (np.abs(values[17:20]).max(), FASTEST_TURN),
    }
    for what, (value, most) in limits.items():
        if abs(value) > most:
            raise fault(path, f"the {what} {value:g} is beyond {most:g}, no car's", _REMEDY)
    rotation = _rotation(roll, pitch, yaw)
    return Oxts(latitude, longitude, altitude, rotation, rotation.T @ np.array([east, north, up]), values[17:20])


def _rotation(roll: float, pitch: float, yaw: float) -> Float64[np.ndarray, "3 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
