"""One short drive in numbers. Writers of layouts write it, and what a reader finds is compared with it.

Everything is numpy float64 in a world far from its origin. Stamps are whole microseconds, which every layout can hold.
A vehicle has x ahead, y left, z up; a camera OpenCV's axes.
"""

from dataclasses import dataclass

import numpy as np

PER_SECOND = 1_000_000_000


def pose(rotation: np.ndarray, translation: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """... x 4 x 4 of rotations ... x 3 x 3 and translations ... x 3."""
    transform = np.zeros((*rotation.shape[:-2], 4, 4))
    transform[..., :3, :3], transform[..., :3, 3], transform[..., 3, 3] = rotation, translation, 1
    return transform


def turned(yaw: np.ndarray | float, pitch: float = 0.0) -> np.ndarray:
    """Rotation about z (left is positive) after one about y (nose down is positive), radians."""
    yaw = np.asarray(yaw, float)
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    about_z = np.stack((np.stack((c, -s, zero), -1), np.stack((s, c, zero), -1), np.stack((zero, zero, one), -1)), -2)
    c, s = np.cos(pitch), np.sin(pitch)
    return about_z @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def moved(a_from_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """n x 3 points of frame b in frame a; one transform for all points, or n."""
    return np.einsum("...ij,...j->...i", a_from_b[..., :3, :3], points) + a_from_b[..., :3, 3]


@dataclass(frozen=True)
class PlannedCamera:
    name: str
    vehicle_from_camera: np.ndarray
    intrinsics: np.ndarray
    """3 x 3, pixel centers at +0.5."""
    delay: int
    """Nanoseconds from the stamp of the frame to the middle of the exposure."""
    width: int = 32
    height: int = 24


@dataclass(frozen=True)
class Plan:
    """A car on a climbing curve, two cameras, a lidar that spins clockwise, and a car ahead of it on a curve too."""

    num_frames: int = 4
    start: int = 1_532_402_927_600_000_000
    period: int = PER_SECOND // 10
    speed: float = 10.0
    yaw_rate: float = 0.2
    origin: tuple[float, float, float] = (4123.5, -2345.25, 31.0)
    box_name: str = "car-1"
    box_size: tuple[float, float, float] = (4.5, 1.9, 1.6)
    beams: int = 6
    columns: int = 60

    @property
    def cameras(self) -> tuple[PlannedCamera, ...]:
        from_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        front = pose(turned(0.02, 0.03) @ from_camera, (1.6, 0.1, 1.6))
        left = pose(turned(np.pi / 4, 0.01) @ from_camera, (1.4, 0.4, 1.55))
        return (
            PlannedCamera("front", front, np.array([[30.0, 0, 16.25], [0, 30.5, 11.5], [0, 0, 1]]), 25_000_000),
            PlannedCamera("left", left, np.array([[28.0, 0, 15.75], [0, 28.5, 12.25], [0, 0, 1]]), 76_000_000),
        )

    @property
    def stamps(self) -> np.ndarray:
        """Of the frames: instants of the sweeps and the boxes."""
        return self.start + self.period * np.arange(self.num_frames, dtype=np.int64)

    def image_stamp(self, frame: int, camera: PlannedCamera) -> int:
        return int(self.stamps[frame]) + camera.delay

    def world_from_vehicle(self, stamps: np.ndarray | int) -> np.ndarray:
        return self._driven(stamps, self.speed, self.yaw_rate, 0.0)

    def world_from_camera(self, frame: int, camera: PlannedCamera) -> np.ndarray:
        return self.world_from_vehicle(self.image_stamp(frame, camera)) @ camera.vehicle_from_camera

    def world_from_box(self, stamps: np.ndarray | int) -> np.ndarray:
        """Axes x along the length, y left, z up; origin at the center."""
        return self._driven(stamps, 8.0, -0.1, 12.0) @ pose(np.eye(3), (0, 0, self.box_size[2] / 2))

    @property
    def vehicle_from_lidar(self) -> np.ndarray:
        return pose(turned(0.3), (1.0, 0.0, 1.9))

    @property
    def azimuths(self) -> np.ndarray:
        """Of the columns in the sensor's frame, in the order of time: clockwise, from behind over the left side."""
        return np.pi * (1 - (2 * np.arange(self.columns) + 1) / self.columns)

    @property
    def inclinations(self) -> np.ndarray:
        """Of the beams, the highest first, radians."""
        return np.linspace(0.05, -0.3, self.beams)

    def ranges(self, frame: int) -> np.ndarray:
        """beams x columns, 5 to 45 m; 0 where nothing came back."""
        ranges = np.random.default_rng(frame).uniform(5, 45, (self.beams, self.columns))
        ranges[np.random.default_rng(100 + frame).random(ranges.shape) < 0.1] = 0
        return ranges

    def point_stamps(self, frame: int) -> np.ndarray:
        """Of the columns: the turn's middle is the stamp of the frame."""
        offsets = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        return self.stamps[frame] + 1000 * np.round(offsets * self.period / 1000).astype(np.int64)

    def sweep(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns as measured: n x 3 points in the sensor's frame of their own instants, and these stamps."""
        ranges = self.ranges(frame)
        beams, columns = np.nonzero(ranges)
        azimuth, inclination = self.azimuths[columns], self.inclinations[beams]
        rays = (np.cos(inclination) * np.cos(azimuth), np.cos(inclination) * np.sin(azimuth), np.sin(inclination))
        return ranges[beams, columns][:, None] * np.stack(rays, -1), self.point_stamps(frame)[columns]

    def world_points(self, frame: int) -> np.ndarray:
        """The same returns where they were in the world, which is what a reader finds."""
        points, stamps = self.sweep(frame)
        return moved(self.world_from_vehicle(stamps) @ self.vehicle_from_lidar, points)

    def image(self, frame: int, camera: PlannedCamera) -> np.ndarray:
        """h x w x 3 uint8, smooth, so that a JPEG of it is off by few levels; no two are alike."""
        rows, columns = np.mgrid[: camera.height, : camera.width]
        number = [one.name for one in self.cameras].index(camera.name)
        planes = (40 + 4 * columns, 60 + 5 * rows, np.full_like(rows, 30 + 40 * frame + 20 * number))
        return np.stack(planes, -1).astype(np.uint8)

    def _driven(self, stamps: np.ndarray | int, speed: float, yaw_rate: float, ahead: float) -> np.ndarray:
        """On a circle at constant speed, climbing 3 %, from ``ahead`` meters along x."""
        seconds = (np.asarray(stamps, np.int64) - self.start) / PER_SECOND
        angle, radius = yaw_rate * seconds, speed / yaw_rate
        path = np.stack((ahead + radius * np.sin(angle), radius * (1 - np.cos(angle)), 0.03 * speed * seconds), -1)
        return pose(turned(angle, -0.03), path + np.array(self.origin))
