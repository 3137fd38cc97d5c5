"""Small logs for tests: a drive in numbers that layouts are written from, one in memory, and when two logs are one."""

from dataclasses import dataclass

import numpy as np
import torch

from sparsestreet.data.lazy import Sweeps, as_frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Camera, Frame, Sweep, Track, View

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


def levels(count: int) -> np.ndarray:
    """Intensities of the returns of a sweep in their order, in [0, 1]: numbers of one byte, no two neighbors alike."""
    return 37 * np.arange(count) % 256 / 255


def check_same_views(found: DrivingLog, wanted: DrivingLog) -> None:
    """Poses in the data set's world, lenses, sizes, times and stamps."""
    assert [view.indices for view in found.views] == [view.indices for view in wanted.views]
    # A log's poses are float32, and a translation is -R^T t of the position: a few roundings of what lies 100 m away.
    for one, other in zip(found.views, wanted.views, strict=True):
        torch.testing.assert_close(in_data_set(found, one), in_data_set(wanted, other), atol=2e-5, rtol=0)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        torch.testing.assert_close(one.camera.intrinsics, other.camera.intrinsics, atol=0, rtol=0)
        torch.testing.assert_close(one.camera.distortion, other.camera.distortion, atol=0, rtol=0)
        assert (one.stamp, one.seconds) == (other.stamp, other.seconds)
        assert abs(one.time - other.time) < 1e-12


def check_same_masks(found: Frame, wanted: Frame) -> None:
    for kind in ("sky", "human", "vehicle", "ego"):
        one, other = getattr(found, kind), getattr(wanted, kind)
        assert (one is None) == (other is None), kind
        assert one is None or torch.equal(one, other), kind


def check_same_sweeps(found: DrivingLog, wanted: DrivingLog) -> None:
    assert (found.sweeps.indices, found.sweeps.stamps) == (wanted.sweeps.indices, wanted.sweeps.stamps)
    for one, other in zip(found.sweeps.gray(), wanted.sweeps.gray(), strict=True):
        assert (one.stamp, one.seconds) == (other.stamp, other.seconds)
        points = transform_points(found.dataset_from_world, one.points.double())
        # float32 around the camera: 4 micrometers at 64 m, and again in the log's world.
        torch.testing.assert_close(
            points, transform_points(wanted.dataset_from_world, other.points.double()), atol=5e-5, rtol=0
        )


def check_same_track(found: DrivingLog, one: Track, wanted: DrivingLog, other: Track) -> None:
    """Boxes in the data set's world, their times, and the body."""
    assert one.frames.tolist() == other.frames.tolist()
    poses, expected = (log.dataset_from_world @ t.world_from_object for log, t in ((found, one), (wanted, other)))
    torch.testing.assert_close(poses, expected, atol=1e-9, rtol=1e-12)  # float64, as text with all digits
    torch.testing.assert_close(one.size, other.size, atol=0, rtol=1e-6)
    assert (one.times is None) == (other.times is None)
    if one.times is not None and other.times is not None:
        torch.testing.assert_close(one.times, other.times, atol=1e-12, rtol=0)
    assert (one.body is None) == (other.body is None)
    if one.body is not None and other.body is not None:
        assert torch.equal(one.body.valid, other.body.valid)
        assert torch.equal(one.body.shape, other.body.shape)
        dots = (one.body.rotations * other.body.rotations).sum(-1)[one.body.valid].abs()
        assert (1 - dots).max() < 1e-6  # float32 matrices in the file: 1e-3 rad at most


def in_data_set(log: DrivingLog, view: View) -> torch.Tensor:
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


INTRINSICS = torch.tensor([[5.0, 0, 2.5], [0, 5.0, 1.5], [0, 0, 1]])


def make_log(num_frames: int = 12, num_cameras: int = 2, sweeps: tuple[Sweep, ...] = ()) -> DrivingLog:
    """Cameras look along world z from (frame, camera, 0); images hold the frame and camera number."""
    frames = []
    for index in range(num_frames):
        for number in range(num_cameras):
            camera_from_world = torch.eye(4)
            camera_from_world[:3, 3] = -torch.tensor([index, number, 0.0])
            image = torch.full((3, 5, 3), (10 * index + number) % 256, dtype=torch.uint8)
            camera = Camera(camera_from_world, INTRINSICS, 5, 3)
            sky = torch.zeros(3, 5, dtype=torch.bool)
            frames.append(Frame(camera, index / max(num_frames - 1, 1), index, number, image=image, sky=sky))
    return DrivingLog(
        "tiny", as_frames(frames), Sweeps.of(sweeps), (), num_frames, num_cameras, torch.eye(4, dtype=torch.float64)
    )
