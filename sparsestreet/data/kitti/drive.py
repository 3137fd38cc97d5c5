"""A log as one drive of KITTI: a rig of parallel cameras on one IMU, and one instant a frame."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.kitti.layout import COLOR, GRAY
from sparsestreet.data.kitti.mercator import Mercator
from sparsestreet.data.kitti.oxts import FASTEST, FASTEST_TURN
from sparsestreet.data.kitti.velodyne import OWN_CAR
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes
from sparsestreet.data.pinhole_frames import check_every_image, rig_of
from sparsestreet.data.placed import PlacedLog
from sparsestreet.data.vehicle import Vehicle, vehicle_of
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.geometry.quaternions import from_matrix, to_rotation_vector
from sparsestreet.types import Sweep, Track, View

EARLIEST = 1_000_000_000
"""Nanoseconds: least stamp of what is written. KITTI's are dates, of which none lies before 1970."""
_CAMERA_PLACE = (1.1, 0.0, 0.7)
"""Of the first camera, ahead of, left of and above the IMU: about that of image_00, as logs do not know their car."""
_PARALLEL = 1e-3
"""Radians between axes of cameras that are taken as parallel: less than a pixel at a focal length of 1,000."""
_NAMES = (*COLOR, *GRAY)
IMU_FROM_LIDAR = torch.eye(4, dtype=torch.float64)
"""Where KITTI's car has its lidar, 0.3 m behind and 0.1 m above the first camera: logs do not know theirs."""
IMU_FROM_LIDAR[:3, 3] = torch.tensor([0.8, 0.0, 0.8], dtype=torch.float64)


@dataclass(frozen=True)
class Deviation:
    """How far images are from where one rigid rig has them."""

    meters: float
    degrees: float
    nanoseconds: int
    """Between the stamps of an image and its frame."""


@dataclass(frozen=True)
class KittiDrive:
    """Cameras that look as the first one does, each at its mean place beside it; the first one gives the instants."""

    placed: PlacedLog
    """Of these cameras alone."""
    names: Mapping[int, str]
    """Index of a camera -> its folder."""
    lost: tuple[str, ...]
    """Cameras that look elsewhere, or are too many."""

    @staticmethod
    def of(log: DrivingLog) -> "KittiDrive":
        """Raises ValueError for a log that lacks an image at some frame."""
        times = LogTimes.of(log, EARLIEST)
        mounts = vehicle_of(log, times, _CAMERA_PLACE).mounts
        first = log.views[0].indices[1]
        parallel = [index for index, mount in mounts.items() if _angle(mounts[first], mount) <= _PARALLEL]
        parallel.sort(key=lambda index: index != first)  # the first one first
        own = dict(enumerate(log.camera_names))
        known = {index: own[index] for index in parallel if own.get(index) in _NAMES}
        free = [name for name in _NAMES if name not in known.values()]
        names = known | dict(zip([index for index in parallel if index not in known], free, strict=False))
        lost = tuple(str(own.get(index, index)) for index in mounts if index not in names)
        kept = replace(log, frames=log.frames.where(lambda view: view.camera_index in names))
        check_every_image(kept, "KITTI")
        return KittiDrive(PlacedLog(kept, times), dict(sorted(names.items())), lost)

    @property
    def log(self) -> DrivingLog:
        return self.placed.log

    @property
    def first(self) -> int:
        """Index of the first camera."""
        return self.log.views[0].indices[1]

    @cached_property
    def shift(self) -> Float64[Tensor, "3"]:
        """What is added to the world, where no drive of KITTI can be at its place."""
        place = self._poses[0][:3, 3]
        return torch.zeros(3, dtype=torch.float64) if Mercator.through(place.numpy()) is not None else -place

    @cached_property
    def plane(self) -> Mercator:
        found = Mercator.through((self._poses[0][:3, 3] + self.shift).numpy())
        assert found is not None  # the origin is on the equator
        return found

    @cached_property
    def stamps(self) -> dict[int, int]:
        """Of each frame: those of the first camera."""
        return {frame: self.placed.view_stamp(view) for frame, view in self._leading.items()}

    @cached_property
    def poses(self) -> dict[int, Float64[Tensor, "4 4"]]:
        """Frame -> world_from_imu, in which the first camera is where it was."""
        move = torch.eye(4, dtype=torch.float64)
        move[:3, 3] = self.shift
        return {frame: move @ pose for frame, pose in self._poses.items()}

    def motion(self, frame: int) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Velocity in the world, m/s, and turn in the IMU's axes, rad/s, from the frames around; zeros where none are.

        Raises ValueError for a motion that no car has.
        """
        near = [at for at in (frame - 1, frame, frame + 1) if at in self.poses]
        if len(near) == 1:
            return np.zeros(3), np.zeros(3)
        before, after = self.poses[near[0]], self.poses[near[-1]]
        seconds = (self.stamps[near[-1]] - self.stamps[near[0]]) / 1e9
        turn = before[:3, :3].T @ after[:3, :3]
        velocity, rate = (after - before)[:3, 3] / seconds, to_rotation_vector(from_matrix(turn)) / seconds
        if velocity.norm() > FASTEST or rate.norm() > FASTEST_TURN:
            raise ValueError(
                f"around frame {frame} the car of {self.log.name!r} drives {float(velocity.norm()):.3g} m/s and turns "
                f"{float(rate.norm()):.3g} rad/s, which KITTI's readers refuse: check the log's stamps and scale"
            )
        return velocity.numpy(), rate.numpy()

    @cached_property
    def rectified_places(self) -> dict[int, Float64[Tensor, "3"]]:
        """Of each camera in the frame of the first one: the mean over the frames."""
        sums = {index: torch.zeros(3, dtype=torch.float64) for index in self.names}
        for view in self.log.views:
            sums[view.indices[1]] += self._beside(view)[:3, 3]
        return {index: total / len(self._leading) for index, total in sums.items()}

    @property
    def camera_from_lidar(self) -> Float64[Tensor, "4 4"]:
        """Of the first camera, whose frame is the rectified one."""
        return inverse(self._mount) @ IMU_FROM_LIDAR

    def intrinsics(self, index: int) -> tuple[Float64[Tensor, "3 3"], tuple[int, int]]:
        """Counted from the center of the first pixel, as KITTI does; and width and height."""
        camera = rig_of(self.log)[index]
        matrix = camera.intrinsics.double()
        matrix[:2, 2] -= 0.5
        return matrix, (camera.width, camera.height)

    def points(self, sweep: Sweep) -> Float64[Tensor, "n 3"]:
        """In the frame of the lidar, where the street is at the frame's stamp."""
        points = self.placed.points(sweep, self.stamps[sweep.index]) + self.shift
        return transform_points(inverse(self.poses[sweep.index] @ IMU_FROM_LIDAR), points)

    def lidar_from_object(self, track: Track, frame: int) -> Float64[Tensor, "4 4"]:
        """At the frame's stamp."""
        return inverse(self._poses[frame] @ IMU_FROM_LIDAR) @ self.placed.box(track, frame, self.stamps[frame])

    def deviation(self) -> Deviation:
        """The largest over all images."""
        meters = degrees = 0.0
        nanoseconds = 0
        for view in self.log.views:
            beside, (frame, index) = self._beside(view), view.indices
            meters = max(meters, float((beside[:3, 3] - self.rectified_places[index]).norm()))
            degrees = max(degrees, math.degrees(_angle(torch.eye(4, dtype=torch.float64), beside)))
            nanoseconds = max(nanoseconds, abs(self.placed.view_stamp(view) - self.stamps[frame]))
        return Deviation(meters, degrees, nanoseconds)

    def near_returns(self) -> tuple[int, int]:
        """Returns that readers take for the own car's, because they lie so near to the lidar; and all. Reads all."""
        distances = [self.points(sweep).norm(dim=1) for sweep in self.log.sweeps.gray()]
        return sum(int((some < OWN_CAR).sum()) for some in distances), sum(map(len, distances))

    @cached_property
    def _leading(self) -> dict[int, View]:
        """Frame -> the view of the first camera."""
        return {view.indices[0]: view for view in self.log.views if view.indices[1] == self.first}

    @cached_property
    def _vehicle(self) -> Vehicle:
        return vehicle_of(self.log, self.placed.times, _CAMERA_PLACE)

    @property
    def _mount(self) -> Float64[Tensor, "4 4"]:
        """imu_from_camera of the first one."""
        return self._vehicle.mounts[self.first]

    @cached_property
    def _poses(self) -> dict[int, Float64[Tensor, "4 4"]]:
        """world_from_imu, in the log's own world."""
        camera_from_imu = inverse(self._mount)
        return {frame: self.placed.world_from_camera(view) @ camera_from_imu for frame, view in self._leading.items()}

    def _beside(self, view: View) -> Float64[Tensor, "4 4"]:
        """The first camera of the frame, from the view's."""
        leading = self._leading[view.indices[0]]
        return inverse(self.placed.world_from_camera(leading)) @ self.placed.world_from_camera(view)


def _angle(one: Float64[Tensor, "4 4"], other: Float64[Tensor, "4 4"]) -> float:
    """Radians between the rotations of two transforms."""
    return float(to_rotation_vector(from_matrix(one[:3, :3].T @ other[:3, :3])).norm())
