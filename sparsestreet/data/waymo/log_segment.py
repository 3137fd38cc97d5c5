"""A log as a segment: the values that both versions of Waymo's Open Dataset hold, to be written."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from sparsestreet.data.directions import names_by_direction
from sparsestreet.data.encoded import jpeg, png
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes, stamps_of_frames
from sparsestreet.data.placed import PlacedLog
from sparsestreet.data.vehicle import AHEAD_FROM_OPENCV, Vehicle, dataset_from_camera, vehicle_of
from sparsestreet.data.waymo.images import SIDES
from sparsestreet.data.waymo.lidar import SPIN
from sparsestreet.data.waymo.pixels import encode_masks
from sparsestreet.data.waymo.range_grid import Placed, RangeGrid
from sparsestreet.data.waymo.segment import CAMERAS, CameraCalibration, ImageMotion, LidarCalibration, canonical
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Camera, Frame, View

READOUT = 44_000_000
"""Nanoseconds from the first column to the last in Waymo's files; a log tells the motion in that time, not the time."""
DIRECTIONS = {"FRONT": 0.0, "FRONT_LEFT": 45.0, "FRONT_RIGHT": -45.0, "SIDE_LEFT": 90.0, "SIDE_RIGHT": -90.0}
"""Degrees to the left of FRONT."""
_GLOBAL = 5
"""The direction of a camera whose pixels are read at once."""
_SECOND = 1_000_000_000
_HALF = SPIN // 2


@dataclass(frozen=True)
class Grid:
    """Where the sensors are, and how fine the range images may be."""

    camera: tuple[float, ...]
    """Place of the first camera in the vehicle: meters ahead, left, up."""
    lidar: tuple[float, ...]
    rows: int
    columns: int


@dataclass(frozen=True)
class LogSegment:
    """What ``Segment`` reads, of a log. Cameras get Waymo's names; there is one lidar, TOP, which sees all.

    Raises ValueError for a log that a segment cannot be.
    """

    log: DrivingLog
    grid: Grid

    @cached_property
    def name(self) -> str:
        return canonical(re.sub(r"[^\w.-]", "_", self.log.name)) or "log"

    @cached_property
    def times(self) -> LogTimes:
        rolling = any(view.camera.shutter is not None for view in self.log.views)
        return LogTimes.of(self.log, READOUT // 2 if rolling else 0)

    @cached_property
    def placed(self) -> PlacedLog:
        return PlacedLog(self.log, self.times)

    @cached_property
    def stamps(self) -> tuple[int, ...]:
        """Microseconds at which the spin of each frame begins: half of it before the sweep's own stamp."""
        return tuple(round((stamp - _HALF) / 1000) for stamp in self.instants)

    @cached_property
    def instants(self) -> tuple[int, ...]:
        """Nanoseconds at which the sweeps are, or the frames without one."""
        return stamps_of_frames(self.log, self.times)

    @cached_property
    def vehicle(self) -> Vehicle:
        return vehicle_of(self.log, self.times, self.grid.camera)

    @cached_property
    def names(self) -> Mapping[int, str]:
        """Camera index -> Waymo's name, by where the camera looks."""
        indices = sorted({view.indices[1] for view in self.log.views})
        if len(indices) > len(CAMERAS):
            raise ValueError(
                f"{self.log.name!r} has {len(indices)} cameras, a segment of Waymo's has {len(CAMERAS)}: choose that "
                "many (data.log.cameras)"
            )
        return names_by_direction(self.placed, DIRECTIONS, "")

    @cached_property
    def cameras(self) -> Mapping[str, CameraCalibration]:
        first: dict[int, Camera] = {}
        for view in self.log.views:
            if not _alike(first.setdefault(view.indices[1], view.camera), view.camera):
                raise ValueError(
                    f"camera {view.indices[1]} of {self.log.name!r} has images of other sizes, lenses or shutters, a "
                    "segment has one calibration of each camera: write a camera for each (a rig.json can)"
                )
        return {name: self._calibration(index, first[index]) for index, name in self.names.items()}

    @cached_property
    def lidar(self) -> LidarCalibration | None:
        """None: the log has no returns."""
        if self._rays is None:
            return None
        angles = tuple(self._rays.inclinations.tolist())
        return LidarCalibration(self._vehicle_from_lidar, angles, (angles[0], angles[-1]))

    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        return self.vehicle.at(1000 * self.stamps[frame] + _HALF)

    def views(self, frame: int) -> dict[str, View]:
        """The images of a frame, by camera."""
        return {self.names[view.indices[1]]: view for view in self._views.get(frame, ())}

    def motion(self, name: str, view: View) -> ImageMotion:
        stamp, camera = self.times.of_view(view), self.cameras[name]
        pose = dataset_from_camera(self.log, view) @ inverse(camera.vehicle_from_camera @ AHEAD_FROM_OPENCV)
        linear, angular = self._velocity(view, camera, pose, stamp)
        half = 0 if camera.direction == _GLOBAL else READOUT // 2
        return ImageMotion(
            pose, linear, angular, stamp / _SECOND, 0.0, (stamp - half) / _SECOND, (stamp + half) / _SECOND
        )

    def places(self, frame: int) -> Placed | None:
        """The returns of a frame; None without any."""
        rays, points = self._rays, self._points(frame)
        return None if rays is None or not len(points) else rays.place(points)

    def pixel_poses(self, frame: int, ranges: Float32[np.ndarray, "2 h w"]) -> Float32[np.ndarray, "h w 6"]:
        """Roll, pitch, yaw, x, y, z of the vehicle, equal for all returns: the points of a log are of one instant."""
        pose = self.world_from_vehicle(frame).numpy()
        angles = (np.arctan2(pose[2, 1], pose[2, 2]), -np.arcsin(pose[2, 0]), np.arctan2(pose[1, 0], pose[0, 0]))
        numbers = np.array([*angles, *pose[:3, 3]], np.float32)
        return np.where(ranges[0, ..., None] > 0, numbers, np.float32(0))

    def picture(self, view: View, quality: int | None) -> bytes:
        """JPEG with colors of all pixels, or PNG without a quality."""
        pixels = self.frame(view).image.numpy()
        return png(pixels) if quality is None else jpeg(pixels, quality)

    def labels(self, view: View) -> bytes | None:
        """A panoptic label from the masks; None for an image that has none."""
        frame = self.frame(view)
        return encode_masks({"sky": frame.sky, "human": frame.human, "vehicle": frame.vehicle}, frame.ego)

    def frame(self, view: View) -> Frame:
        return self.log.frames[self._order[view.indices]]

    @cached_property
    def _order(self) -> dict[tuple[int, int], int]:
        return {view.indices: place for place, view in enumerate(self.log.views)}

    @cached_property
    def _views(self) -> dict[int, list[View]]:
        found: dict[int, list[View]] = {}
        for view in self.log.views:
            found.setdefault(view.indices[0], []).append(view)
        return found

    @cached_property
    def _rays(self) -> RangeGrid | None:
        if not any(len(sweep.points) for sweep in self.log.sweeps.gray()):
            return None
        sweeps = (self._points(frame) for frame in self.log.sweeps.indices)
        return RangeGrid.fitting(sweeps, self.grid.rows, self.grid.columns)

    @cached_property
    def _vehicle_from_lidar(self) -> Float64[Tensor, "4 4"]:
        mount = torch.eye(4, dtype=torch.float64)
        mount[:3, 3] = torch.tensor(self.grid.lidar, dtype=torch.float64)
        return mount

    def _points(self, frame: int) -> Float64[np.ndarray, "n 3"]:
        """As the lidar sees them."""
        if frame not in self.log.sweeps.indices:
            return np.zeros((0, 3))
        lidar_from_world = (
            inverse(self.world_from_vehicle(frame) @ self._vehicle_from_lidar) @ self.log.dataset_from_world
        )
        return transform_points(lidar_from_world, self.log.sweeps.load_gray(frame).points.double()).numpy()

    def _calibration(self, index: int, camera: Camera) -> CameraCalibration:
        k = camera.intrinsics.tolist()
        lens = (0.0,) * 5 if camera.distortion is None else camera.distortion.tolist()
        side = None if camera.shutter is None else camera.shutter.direction
        direction = next((number for number, one in SIDES.items() if one == side), _GLOBAL)
        mount = self.vehicle.mounts[index] @ inverse(AHEAD_FROM_OPENCV)
        return CameraCalibration(
            (k[0][0], k[1][1], k[0][2], k[1][2], *lens), mount, (camera.width, camera.height), direction
        )

    def _velocity(
        self, view: View, camera: CameraCalibration, pose: Float64[Tensor, "4 4"], stamp: int
    ) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "3"]]:
        """The linear and the angular one that ``images.shutter`` turns into the view's shutter; else the path's."""
        seconds, shutter = READOUT / _SECOND, view.camera.shutter
        if shutter is None:
            moved, turned = self.vehicle.path.motion_during(stamp, READOUT)
            return pose[:3, :3] @ moved.double() / seconds, turned.double() / seconds
        world_from_camera = dataset_from_camera(self.log, view)[:3, :3]
        angular = pose[:3, :3].T @ world_from_camera @ shutter.rotation.double() / seconds
        lever = pose[:3, :3] @ torch.linalg.cross(angular, camera.vehicle_from_camera[:3, 3])
        return world_from_camera @ shutter.translation.double() / seconds - lever, angular


def _alike(one: Camera, other: Camera) -> bool:
    """Whether one calibration says both."""
    lenses = [torch.zeros(5) if camera.distortion is None else camera.distortion for camera in (one, other)]
    sides = [None if camera.shutter is None else camera.shutter.direction for camera in (one, other)]
    sizes = [(camera.width, camera.height) for camera in (one, other)]
    alike = torch.equal(one.intrinsics, other.intrinsics) and torch.equal(*lenses)
    return alike and sides[0] == sides[1] and sizes[0] == sizes[1]
