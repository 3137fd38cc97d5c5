"""What a segment of Waymo's Open Dataset holds, in Waymo's own axes and units, whichever release it is read from.

The vehicle's axes, and a camera's, are x forward, y left, z up. The world is Waymo's global one: east, north, up.
"""

import os
import tempfile
import weakref
from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sparsestreet.data.frame_cache import Lock
from sparsestreet.data.poses import check_rigid
from sparsestreet.data.problems import Problem, fault
from sparsestreet.data.reader import LogFiles

CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
LIDARS = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
CLASSES = {1: "Vehicle", 2: "Pedestrian", 3: "Sign", 4: "Cyclist"}
REMEDY = "download the file again from Waymo"
_MAX_SIDE = 16_384
"""Pixels: ten times what the cameras have."""
_LONGEST_EXPOSURE = 0.5
"""Seconds from the trigger to the end of the readout: ten times what was seen."""


@dataclass(frozen=True)
class CameraCalibration:
    """What is the same in all images of a camera."""

    intrinsic: tuple[float, ...]
    """f_u, f_v, c_u, c_v in pixels from the left and upper edge, then k1, k2, p1, p2, k3 as OpenCV has them."""
    vehicle_from_camera: Float64[Tensor, "4 4"]
    size: tuple[int, int]
    """Width, height, pixels."""
    direction: int
    """In which order pixels are read: 1 rows from the top, 2 columns from the left, 3 rows from below, 4 columns from
    the right, 5 all at once, 0 not known."""


@dataclass(frozen=True)
class LidarCalibration:
    """Where a lidar's rays point."""

    vehicle_from_lidar: Float64[Tensor, "4 4"]
    inclinations: tuple[float, ...]
    """Of the rows, radians, from the lowest to the highest; empty: evenly spread within ``limits``."""
    limits: tuple[float, float]
    """Least and greatest inclination, radians."""


@dataclass(frozen=True)
class ImageMotion:
    """Where the vehicle was, and how it moved, when an image was taken. Times are seconds of Waymo's clock."""

    world_from_vehicle: Float64[Tensor, "4 4"]
    """At ``pose_time``, which is near the image's own instant, not equal to it."""
    linear: Float64[Tensor, "3"]
    """m/s along the world's axes."""
    angular: Float64[Tensor, "3"]
    """rad/s about the vehicle's axes."""
    pose_time: float
    exposure: float
    """Seconds that a row or column is exposed."""
    trigger: float
    readout_done: float


@dataclass(frozen=True)
class BoxLabel:
    """A box of a frame, in the vehicle's frame at the frame's pose."""

    name: str
    kind: int
    """A key of CLASSES."""
    box: tuple[float, ...]
    """Center x, y, z, length, width, height in meters, heading in radians from x to y."""
    seen_box: tuple[float, ...] | None = None
    """The box at the instant when ``seen_by`` saw it (``camera_synced_box``); None: not seen, or an older file."""
    seen_by: str | None = None


@dataclass(frozen=True)
class Returns:
    """The returns of one lidar in one frame; both returns of a pixel are rows of their own."""

    lidar: str
    shape: tuple[int, int]
    """Rows and columns of the range image."""
    pixels: Int64[np.ndarray, " n"]
    """row * columns + column of each."""
    ranges: Float[np.ndarray, " n"]
    """Meters."""
    intensities: Float[np.ndarray, " n"]
    """Unbounded; few are above 1."""
    poses: Float[np.ndarray, "h w 6"] | None = None
    """Of the lidar TOP: roll, pitch, yaw, x, y, z of the vehicle in the world at each pixel's own instant."""


class Segment(ABC):
    """About 20 s of a drive, from the files of one release. All methods raise LogError for broken files."""

    name: str
    stamps: Sequence[int]
    """Microseconds at which the spin of each frame began."""
    cameras: Mapping[str, CameraCalibration]
    lidars: Mapping[str, LidarCalibration]
    source: Path
    """The file of the frames' poses."""
    calibration_file: Path
    """Of cameras."""
    image_file: Path
    box_file: Path
    lidar_file: Path
    label_file: Path
    """Of panoptic labels."""
    notes: tuple[str, ...] = ()

    @abstractmethod
    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        """The pose that the frame's boxes and returns refer to, of half of the spin."""

    @abstractmethod
    def images(self, frame: int) -> Mapping[str, ImageMotion]:
        """The images that the frame has, by camera."""

    @abstractmethod
    def jpeg(self, frame: int, camera: str) -> bytes:
        """An image as it is stored."""

    @abstractmethod
    def boxes(self, frame: int) -> Sequence[BoxLabel]: ...

    @property
    @abstractmethod
    def has_boxes(self) -> bool: ...

    @property
    @abstractmethod
    def labelled(self) -> frozenset[tuple[int, str]]:
        """Frames and cameras whose pixels were labelled by hand."""

    @abstractmethod
    def panoptic(self, frame: int, camera: str) -> tuple[bytes, int]:
        """A PNG of class * divisor + instance, and the divisor."""

    @abstractmethod
    def has_returns(self, frame: int) -> bool: ...

    @abstractmethod
    def returns(self, frame: int) -> Sequence[Returns]:
        """Of each lidar that the frame has."""

    @abstractmethod
    def files(self) -> LogFiles: ...

    def check_files(self) -> list[Problem]:
        """What is wrong with the files as such, all bytes of which are read."""
        return []


def canonical(name: str) -> str:
    """A segment's name without what files add to it.

    >>> canonical("segment-1024_3580_000_3600_000_with_camera_labels.tfrecord")
    '1024_3580_000_3600_000'
    """
    name = name.strip().removesuffix(".tfrecord").removesuffix(".parquet")
    return name.removeprefix("segment-").removesuffix("_with_camera_labels")


def transform(values: Sequence[float] | np.ndarray, path: Path, what: str) -> Float64[Tensor, "4 4"]:
    """A rigid transform from its 16 numbers, row by row. Raises LogError for other ones, naming the file."""
    if len(values) != 16:
        raise fault(path, f"{what} has {len(values)} numbers, not 16", REMEDY)
    matrix = torch.from_numpy(np.array(values, dtype=np.float64).reshape(4, 4))
    check_rigid(matrix, path, what)
    return matrix


def camera_calibration(
    intrinsic: Sequence[float],
    extrinsic: Sequence[float] | np.ndarray,
    size: tuple[int, int],
    direction: int,
    path: Path,
    name: str,
) -> CameraCalibration:
    """Checked: nine finite intrinsics, a size that an image can have, a direction of Waymo's six."""
    what = f"the calibration of camera {name}"
    if len(intrinsic) != 9 or not np.isfinite(intrinsic).all() or min(intrinsic[:2]) <= 0:
        message = f"{what} has the intrinsics {[float(value) for value in intrinsic][:12]}"
        raise fault(path, f"{message}, not nine numbers with focal lengths above 0", REMEDY)
    if not all(0 < side <= _MAX_SIDE for side in size):
        raise fault(path, f"{what} has images of {size[0]}x{size[1]} pixels", REMEDY)
    if direction not in range(6):
        raise fault(path, f"{what} has the rolling_shutter_direction {direction}, not one of 0 to 5", REMEDY)
    mount = transform(extrinsic, path, f"{what}: extrinsic")
    return CameraCalibration(tuple(map(float, intrinsic)), mount, size, direction)


def lidar_calibration(
    extrinsic: Sequence[float] | np.ndarray,
    inclinations: Sequence[float] | np.ndarray,
    limits: tuple[float, float],
    path: Path,
    name: str,
) -> LidarCalibration:
    """Checked: finite inclinations within a quarter turn, that ascend."""
    what = f"the calibration of lidar {name}"
    angles = np.array([*inclinations, *limits], dtype=np.float64)
    if not (np.abs(angles) <= np.pi / 2 + 1e-6).all() or not (np.diff(inclinations) > 0).all() or limits[0] > limits[1]:
        raise fault(path, f"{what} has inclinations that are no ascending angles up to a quarter turn", REMEDY)
    mount = transform(extrinsic, path, f"{what}: extrinsic")
    return LidarCalibration(mount, tuple(map(float, inclinations)), limits)


def image_motion(
    pose: Sequence[float] | np.ndarray,
    velocity: Sequence[float],
    times: tuple[float, float, float, float],
    path: Path,
    what: str,
) -> ImageMotion:
    """Checked: finite velocities, and times in an order that a camera can have.

    ``velocity``: linear, then angular; ``times``: pose_timestamp, shutter, camera_trigger_time,
    camera_readout_done_time.
    """
    pose_time, exposure, trigger, done = times
    if not np.isfinite(velocity).all() or not np.isfinite(times).all() or min(pose_time, trigger) < 0:
        raise fault(path, f"{what} has velocities or times that are NaN, infinite or negative", REMEDY)
    if not (0 <= exposure <= done - trigger <= _LONGEST_EXPOSURE and abs(pose_time - trigger) <= _LONGEST_EXPOSURE):
        message = (
            f"{what} was triggered at {trigger:.6f} s, exposed {exposure:g} s, read out by {done:.6f} s, its pose is "
            f"of {pose_time:.6f} s: no camera takes an image so"
        )
        raise fault(path, message, REMEDY)
    linear, angular = torch.tensor(velocity, dtype=torch.float64).view(2, 3)
    return ImageMotion(transform(pose, path, f"{what}: pose"), linear, angular, *times)


def box_label(
    name: str,
    kind: int,
    box: Sequence[float],
    path: Path,
    what: str,
    *,
    seen_box: Sequence[float] | None = None,
    seen_by: str | None = None,
) -> BoxLabel:
    """Checked: a name, a class of Waymo's, finite boxes."""
    if not name:
        raise fault(path, f"a box of {what} has no id", REMEDY)
    if kind not in CLASSES:
        raise fault(path, f"box {name} of {what} has the type {kind}, not one of {CLASSES}", REMEDY)
    for one in (box, seen_box):
        if one is not None and not (np.isfinite(one).all() and np.abs(one[:3]).max() < 1000 and min(one[3:6]) > 0):
            message = f"box {name} of {what} has the center, size and heading {[round(float(v), 3) for v in one]}"
            raise fault(path, f"{message}: no box can be so", REMEDY)
    return BoxLabel(name, kind, tuple(box), None if seen_box is None else tuple(seen_box), seen_by)


FARTHEST = 1000.0
"""Meters: no return is from there."""
SPIN = 100_000_000
"""Nanoseconds of a turn of the lidar TOP."""


def returns_of(
    lidar: str, images: list[Float[np.ndarray, "_ _ c"]], poses: Float[np.ndarray, "_ _ 6"] | None
) -> Returns:
    """What came back, of the range images of the first and the second return, whose channels begin with range and
    intensity."""
    pixels, ranges, intensities = [], [], []
    for image in images:
        values = image[..., 0].ravel()
        some = np.flatnonzero(values > 0)
        pixels.append(some)
        ranges.append(values[some])
        intensities.append(image[..., 1].ravel()[some])
    height, width = images[0].shape[:2]
    numbers = np.concatenate(ranges), np.concatenate(intensities)
    return Returns(lidar, (height, width), np.concatenate(pixels), numbers[0], numbers[1], poses)


def check_returns(returns: Returns, lidar: LidarCalibration | None, path: Path, frame: int) -> LidarCalibration:
    """The calibration. Raises LogError, naming the file, for returns that it or the poses of the pixels do not fit."""
    what = f"lidar {returns.lidar}"
    if lidar is None:
        raise fault(path, f"{what} has range images, but no calibration", REMEDY)
    if len(lidar.inclinations) not in (0, returns.shape[0]):
        message = f"{what} has range images of {returns.shape} pixels, but {len(lidar.inclinations)} inclinations"
        raise fault(path, message, REMEDY)
    what = f"{what} at frame {frame}"
    if returns.poses is not None and returns.poses.shape[:2] != returns.shape:
        message = f"{what} has a range image of {returns.shape} pixels, and poses of {returns.poses.shape[:2]}"
        raise fault(path, message, REMEDY)
    broken = int((~(returns.ranges < FARTHEST)).sum())
    if broken or not (returns.poses is None or np.isfinite(returns.poses).all()):
        message = f"{what} has {broken} ranges that are NaN, infinite or more than {FARTHEST:g} m, or such poses"
        raise fault(path, message, REMEDY)
    return lidar


def world_points(
    returns: Returns, lidar: LidarCalibration, world_from_vehicle: Float64[Tensor, "4 4"]
) -> tuple[Float64[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Where the rays ended, in the world, and the intensity of what came back.

    Returns of TOP lie where they were measured, each by the pose of its pixel; those without a pose (all zeros) are
    left out. The files have the points of the other lidars at the pose of the frame, ``world_from_vehicle``.
    """
    mount = lidar.vehicle_from_lidar.numpy()
    rays = _rays(lidar.inclinations, lidar.limits, float(np.arctan2(mount[1, 0], mount[0, 0])), returns.shape)
    in_sensor = returns.ranges.astype(np.float64)[:, None] * rays[returns.pixels]
    in_vehicle = in_sensor @ mount[:3, :3].T + mount[:3, 3]
    if returns.poses is None:
        pose = world_from_vehicle.numpy()
        return in_vehicle @ pose[:3, :3].T + pose[:3, 3], returns.intensities
    poses = returns.poses.reshape(-1, 6)[returns.pixels].astype(np.float64)
    posed = poses.any(1)
    return _turned(poses[posed, :3], in_vehicle[posed]) + poses[posed, 3:], returns.intensities[posed]


def crossing(x: float, y: float) -> int:
    """Nanoseconds after the start of the spin at which the lidar looks at a place of the vehicle's frame."""
    return round((np.pi - np.arctan2(y, x)) / (2 * np.pi) * SPIN)


@lru_cache(maxsize=8)
def _rays(
    inclinations: tuple[float, ...], limits: tuple[float, float], yaw: float, shape: tuple[int, int]
) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors of all pixels in the sensor's frame, which is turned by ``yaw`` against the vehicle's."""
    height, width = shape
    low, high = limits
    rows = np.array(inclinations) if inclinations else (np.arange(height) + 0.5) / height * (high - low) + low
    inclination = rows[::-1, None]
    azimuth = ((width - np.arange(width) - 0.5) / width * 2 - 1) * np.pi - yaw
    flat = np.cos(inclination)
    rays = (flat * np.cos(azimuth), flat * np.sin(azimuth), np.broadcast_to(np.sin(inclination), shape))
    return np.stack(rays, -1).reshape(-1, 3)


def _turned(angles: Float64[np.ndarray, "n 3"], points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll) of each point, for angles roll, pitch, yaw."""
    (x, y, z), (roll, pitch, yaw) = points.T, angles.T
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    x, z = np.cos(pitch) * x + np.sin(pitch) * z, np.cos(pitch) * z - np.sin(pitch) * x
    return np.stack((np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z), -1)


class Spool:
    """Bytes by key. They go to the folder for temporary files (TMPDIR), not to memory."""

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._places: dict[Hashable, tuple[int, int]] = {}
        self._end = 0
        self._lock = Lock()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._places

    def put(self, key: Hashable, data: bytes) -> None:
        """Raise LogError where the folder has no room."""
        try:
            with self._lock:
                file = self._opened()
                start, self._end = self._end, self._end + len(data)
            done = 0
            while done < len(data):
                done += os.pwrite(file.fileno(), data[done:], start + done)
        except OSError as error:
            folder, remedy = Path(tempfile.gettempdir()), "make room, or set TMPDIR to a folder with room"
            raise fault(folder, f"{len(data)} bytes of decoded data cannot be kept here ({error})", remedy) from error
        self._places[key] = start, len(data)

    def get(self, key: Hashable) -> bytes:
        start, length = self._places[key]
        return os.pread(self._opened().fileno(), length, start)

    def _opened(self) -> BinaryIO:
        if self._file is None:
            # Open as long as this object lives.
            self._file = tempfile.TemporaryFile(prefix="sparsestreet-")  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        return self._file
