"""Scans of streets of boxes, traced ray by ray: a lidar of few beams, a road, walls, and things that move."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sparsestreet.tracking.scans import Scan

Place = Callable[[float], tuple[float, float, float]]
"""Seconds -> x, y of the middle in meters, and yaw in radians."""


@dataclass(frozen=True)
class Thing:
    """A box on the road."""

    size: tuple[float, float, float]
    place: Place

    def pose(self, seconds: float, slope: float = 0.0) -> np.ndarray:
        x, y, yaw = self.place(seconds)
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        pose[:3, 3] = x, y, slope * x + self.size[2] / 2
        return pose


def standing(x: float, y: float, size: tuple[float, float, float]) -> Thing:
    return Thing(size, lambda seconds: (x, y, 0.0))


CAR, PERSON = (4.5, 1.8, 1.5), (0.6, 0.6, 1.7)
WALLS = (standing(0.0, 14.0, (120.0, 0.4, 5.0)), standing(0.0, -9.0, (120.0, 0.4, 5.0)))
PARKED = standing(4.0, 10.0, CAR)


def rays(beams: int = 32, columns: int = 540, low: float = -14.0, high: float = 3.0) -> np.ndarray:
    """Unit directions of a turn, half as far apart as the bins of the tests' range images, or a bit more."""
    elevation = np.radians(np.linspace(low, high, beams))[:, None]
    azimuth = (np.arange(columns) + 0.5) * 2 * np.pi / columns
    parts = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth)
    return np.stack(parts, -1).reshape(-1, 3)


def traced(
    things: Sequence[Thing], seconds: float, origin: np.ndarray, directions: np.ndarray, slope: float = 0.0
) -> np.ndarray:
    """Where rays first meet the road z = slope x or a thing, by slabs, within 60 m; the others are left out."""
    with np.errstate(divide="ignore", invalid="ignore"):
        fall = directions[:, 2] - slope * directions[:, 0]
        ranges = np.where(fall < 0, (slope * origin[0] - origin[2]) / fall, np.inf)
        for thing in things:
            pose, half = thing.pose(seconds, slope), np.array(thing.size) / 2
            start, ray = (origin - pose[:3, 3]) @ pose[:3, :3], directions @ pose[:3, :3]
            ends = np.stack(((-half - start) / ray, (half - start) / ray))
            enter, leave = ends.min(0).max(1), ends.max(0).min(1)
            ranges = np.where((enter < leave) & (enter > 0), np.minimum(ranges, enter), ranges)
    met = ranges < 60
    return origin + ranges[met, None] * directions[met]


def drive(
    things: Sequence[Thing],
    frames: int = 22,
    step: float = 0.1,
    slope: float = 0.0,
    directions: np.ndarray | None = None,
    start: tuple[float, float] = (-4.0, 0.0),
    speed: float = 3.0,
) -> list[Scan]:
    """Scans of a lidar 1.8 m above the road that drives along x."""
    directions = rays() if directions is None else directions
    noise = np.random.default_rng(3)
    scans = []
    for frame in range(frames):
        seconds = frame * step
        x = start[0] + speed * seconds
        origin = np.array([x, start[1], 1.8 + slope * x])
        points = traced((*WALLS, PARKED, *things), seconds, origin, directions, slope)
        away = (points - origin) / np.linalg.norm(points - origin, axis=1, keepdims=True)
        scans.append(Scan(frame, seconds, points + away * noise.normal(0, 0.01, (len(points), 1)), origin))
    return scans
