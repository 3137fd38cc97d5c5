"""Points of the world from range images.

A pixel is a ray of the sensor, its value the length. Rows are inclinations from the highest to the lowest, columns
azimuths: column 0 looks to the rear of the vehicle, and columns go clockwise seen from above.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.problems import fault
from sparsestreet.data.waymo.segment import REMEDY, LidarCalibration, Returns

FARTHEST = 1000.0
"""Meters: no return is from there."""
SPIN = 100_000_000
"""Nanoseconds of a turn of the lidar TOP."""


def returns_of(
    lidar: str, images: list[Float[np.ndarray, "_ _ c"]], poses: Float[np.ndarray, "_ _ 6"] | None
) -> Returns:
    """What came back, of the range images of the first and the second return; range is their first channel."""
    pixels, ranges = [], []
    for image in images:
        values = image[..., 0].ravel()
        some = np.flatnonzero(values > 0)
        pixels.append(some)
        ranges.append(values[some])
    height, width = images[0].shape[:2]
    return Returns(lidar, (height, width), np.concatenate(pixels), np.concatenate(ranges), poses)


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
) -> Float64[np.ndarray, "n 3"]:
    """Where the rays ended, in the world.

    Returns of TOP lie where they were measured, each by the pose of its pixel; those without a pose (all zeros) are
    left out. The files have the points of the other lidars at the pose of the frame, ``world_from_vehicle``.
    """
    mount = lidar.vehicle_from_lidar.numpy()
    rays = _rays(lidar.inclinations, lidar.limits, float(np.arctan2(mount[1, 0], mount[0, 0])), returns.shape)
    in_sensor = returns.ranges.astype(np.float64)[:, None] * rays[returns.pixels]
    in_vehicle = in_sensor @ mount[:3, :3].T + mount[:3, 3]
    if returns.poses is None:
        pose = world_from_vehicle.numpy()
        return in_vehicle @ pose[:3, :3].T + pose[:3, 3]
    poses = returns.poses.reshape(-1, 6)[returns.pixels].astype(np.float64)
    posed = poses.any(1)
    return _turned(poses[posed, :3], in_vehicle[posed]) + poses[posed, 3:]


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
