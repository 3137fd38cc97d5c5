"""The common drive (tests/data/plan.py) in the numbers that Waymo's files hold, for the writers of both versions.

Nothing of the package is used, so that the two cannot be wrong together.
"""

import io
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from PIL import Image

from tests.data.plan import PER_SECOND, Plan, PlannedCamera, levels, moved, pose, turned

OPENCV = pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0, 0, 0))
"""Waymo's camera axes (x forward, y left, z up) from OpenCV's."""
NAMES = {"front": 1, "left": 2}
LENS = (0.04, -0.33, 0.001, -0.0012, 0.0)
EXPOSURE, READOUT = 4_000_000, 44_000_000
HALF_SPIN = 50_000_000
DIVISOR = 1000


@dataclass(frozen=True)
class Drive(Plan):
    """The plan with lenses and shutters over columns. Its lidar is TOP; a small one in front is added."""

    directions: dict[str, int] = field(default_factory=lambda: {"front": 2, "left": 4})
    pose_delays: dict[str, int] = field(default_factory=lambda: {"front": 0, "left": 0})
    """Nanoseconds from the middle of the readout to the instant of the pose."""
    scale: int = 1
    """Pixels of the images for one of the plan's."""
    synced: bool = True
    """Whether the files have the box of the instant when the front camera saw it."""
    labelled: tuple[tuple[int, str], ...] = ((1, "front"),)

    @property
    def cameras(self) -> tuple[PlannedCamera, ...]:
        k = np.diag([self.scale, self.scale, 1.0])
        return tuple(
            PlannedCamera(
                one.name,
                one.vehicle_from_camera,
                k @ one.intrinsics,
                one.delay,
                one.width * self.scale,
                one.height * self.scale,
            )
            for one in super().cameras
        )

    @property
    def azimuths(self) -> np.ndarray:
        """Column 0 looks to the rear of the vehicle, whichever way the sensor is mounted."""
        return super().azimuths - 0.3

    def begin(self, frame: int) -> int:
        """The frame's own stamp: when the spin begins."""
        return int(self.stamps[frame]) - HALF_SPIN

    def frame_pose(self, frame: int) -> np.ndarray:
        return self.world_from_vehicle(int(self.stamps[frame]))

    def velocity(self, stamp: int) -> np.ndarray:
        """Linear along the world's axes, angular about the vehicle's, which climbs."""
        angle = self.yaw_rate * (stamp - self.start) / PER_SECOND
        linear = self.speed * np.array([np.cos(angle), np.sin(angle), 0.03])
        angular = self.world_from_vehicle(stamp)[:3, :3].T @ np.array([0, 0, self.yaw_rate])
        return np.concatenate((linear, angular))

    def image_pose_stamp(self, frame: int, camera: PlannedCamera) -> int:
        return self.image_stamp(frame, camera) + self.pose_delays[camera.name]

    def image_times(self, frame: int, camera: PlannedCamera) -> tuple[float, float, float, float]:
        """Seconds: of the pose, exposure, trigger, end of the readout."""
        middle, half = self.image_stamp(frame, camera), (READOUT + EXPOSURE) // 2
        stamps = (self.image_pose_stamp(frame, camera), EXPOSURE, middle - half, middle + half)
        return tuple(stamp / PER_SECOND for stamp in stamps)  # pyright: ignore[reportReturnType]

    def intrinsic(self, camera: PlannedCamera) -> list[float]:
        k = camera.intrinsics
        return [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *LENS]

    def pixels(self, camera: PlannedCamera, world_from_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Where OpenCV projects points of the world; its pixel coordinates are ours, as K is."""
        seen = moved(np.linalg.inv(world_from_camera), points)
        return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), camera.intrinsics, np.array(LENS))[0][:, 0]

    def read_at(self, frame: int, camera: PlannedCamera, place) -> tuple[int, np.ndarray]:
        """When the row or column that shows ``place`` (of a stamp) is read, and its pixel, by bisection."""
        middle, direction = self.image_stamp(frame, camera), self.directions[camera.name]
        axis, sign = (0 if direction in (2, 4) else 1), (1 if direction in (1, 2) else -1)
        side = (camera.width, camera.height)[axis]
        low, high = middle - READOUT // 2, middle + READOUT // 2
        mount = camera.vehicle_from_camera
        while high - low > 1:
            stamp = (low + high) // 2
            (pixel,) = self.pixels(camera, self.world_from_vehicle(stamp) @ mount, place(stamp)[None])
            read = middle + sign * (pixel[axis] / side - 0.5) * READOUT
            low, high = (stamp, high) if read > stamp else (low, stamp)
        return low, self.pixels(camera, self.world_from_vehicle(low) @ mount, place(low)[None])[0]

    def box_stamp(self, frame: int) -> int:
        """When the beam crosses the box's center, as the pose of the frame sees it."""
        stamp = int(self.stamps[frame])
        for _ in range(50):
            x, y = (np.linalg.inv(self.frame_pose(frame)) @ self.world_from_box(stamp))[:2, 3]
            stamp = self.begin(frame) + round((np.pi - np.arctan2(y, x)) / (2 * np.pi) * 2 * HALF_SPIN)
        return stamp

    def seen_stamp(self, frame: int) -> int:
        return self.read_at(frame, self.cameras[0], lambda stamp: self.world_from_box(stamp)[:3, 3])[0]

    def box(self, frame: int, stamp: int) -> list[float]:
        """Center, length, width, height and heading in the vehicle's frame at the pose of the frame."""
        box = np.linalg.inv(self.frame_pose(frame)) @ self.world_from_box(stamp)
        return [*box[:3, 3], *self.box_size, float(np.arctan2(box[1, 0], box[0, 0]))]

    @cached_property
    def ahead_from_lidar(self) -> np.ndarray:
        """Mount of the lidar FRONT."""
        return pose(turned(-0.1, 0.02), (4.0, 0.1, 0.7))

    def top(self, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range images of both returns (range, intensity, elongation, no label zone) and the poses of the pixels."""
        first = np.zeros((self.beams, self.columns, 4), np.float32)
        first[..., 0], first[..., 1] = self.ranges(frame), levels(self.beams * self.columns).reshape(first.shape[:2])
        first[first[..., 0] == 0] = -1
        second = np.full_like(first, -1)
        second[0, ::7, 0] = np.where(first[0, ::7, 0] > 0, first[0, ::7, 0] + 2, -1)
        poses = self.world_from_vehicle(self.point_stamps(frame))
        angles = [np.arctan2(poses[:, 2, 1], poses[:, 2, 2]), -np.arcsin(poses[:, 2, 0])]
        angles += [np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), *poses[:, :3, 3].T]
        matrix = np.repeat(np.stack(angles, -1)[None], self.beams, 0)
        matrix[first[..., 0] <= 0] = 0
        return first, second, matrix.astype(np.float32)

    def intensities(self, frame: int) -> np.ndarray:
        """Of all returns, in [0, 1]: those of second returns are not known, and those of FRONT lie above."""
        images = (*self.top(frame)[:2], self.ahead(frame))
        return np.concatenate([image[..., 1][image[..., 0] > 0] for image in images]).clip(0, 1)

    def ahead(self, frame: int) -> np.ndarray:
        """Range image of the lidar FRONT, whose inclinations are spread evenly."""
        ranges = np.random.default_rng(50 + frame).uniform(2, 9, (4, 16, 4)).astype(np.float32)
        ranges[1, 3] = -1
        return ranges

    def points(self, frame: int) -> np.ndarray:
        """Where all returns were in the world: first and second of TOP, then those of FRONT."""
        first, second, _ = self.top(frame)
        found = []
        for image in (first, second):
            rows, columns = np.nonzero(image[..., 0] > 0)
            rays = _rays(self.inclinations[rows], self.azimuths[columns])
            points = image[rows, columns, :1].astype(float) * rays
            poses = self.world_from_vehicle(self.point_stamps(frame)[columns]) @ self.vehicle_from_lidar
            found.append(moved(poses, points))
        image = self.ahead(frame)
        rows, columns = np.nonzero(image[..., 0] > 0)
        low, high = -np.pi / 2, np.pi / 6
        # Row 0 is the highest of four bands of equal height; column 0 looks to the rear of the vehicle.
        inclination = high - (rows + 0.5) / 4 * (high - low)
        azimuth = np.pi - 2 * np.pi * (columns + 0.5) / 16 + 0.1
        points = image[rows, columns, :1].astype(float) * _rays(inclination, azimuth)
        return np.concatenate((*found, moved(self.frame_pose(frame) @ self.ahead_from_lidar, points)))

    def png(self, frame: int, camera: PlannedCamera) -> bytes:
        """Not JPEG, as Waymo has it, which would change pixels. Enlarged images are left out: no test looks at them."""
        return b"none" if self.scale > 1 else encoded(self.image(frame, camera))

    def panoptic(self, camera: PlannedCamera) -> bytes:
        """Sky in the upper rows, a car and a pedestrian at the left, road elsewhere."""
        classes = np.full((camera.height, camera.width), 20)
        classes[: camera.height // 4] = 25
        classes[-4:, :5], classes[-8:-4, :3] = 2, 9
        return encoded((classes * DIVISOR + 7).astype(np.uint16))


def encoded(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def _rays(inclination: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    flat = np.cos(inclination)
    return np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(inclination)), -1)
