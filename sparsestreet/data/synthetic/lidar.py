"""A spinning lidar on the roof, which takes the whole turn at the instant of the images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16

from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.parts import BACKGROUND, Pose, at
from sparsestreet.data.synthetic.scene import Scene
from sparsestreet.data.synthetic.sensor import LidarSensor
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.tracer import Rays, first_hits

_AHEAD = 0.9
"""Meters ahead of the rear axle, in the middle of the roof."""


@dataclass(frozen=True)
class StreetSweep:
    points: Float32[np.ndarray, "n 4"]
    """x, y, z (meters, lidar frame: x forward, y left, z up) and intensity in [0, 1]; first returns with noise."""
    object_indices: Int16[np.ndarray, " n"]
    world_from_lidar: Pose


def sweep(settings: StreetSettings, scene: Scene, world_from_ego: Pose, frame: int) -> StreetSweep:
    """Returns one turn of the sensor; ``frame`` only seeds dropout and noise."""
    sensor = settings.lidar
    world_from_lidar = world_from_ego @ at(_AHEAD, 0.0, sensor.height)
    local = _directions(sensor)
    world = np.einsum("ij,jhw->ihw", world_from_lidar[:3, :3].astype(np.float32), local)
    hits = first_hits(scene, Rays(world_from_lidar[:3, 3].astype(np.float32), np.ascontiguousarray(world)))
    rng = stream(settings.seed, f"lidar {frame}")
    kept = rng.random(hits.distances.shape) >= sensor.dropout
    returned = kept & (hits.distances < sensor.max_range)
    ranges = hits.distances[returned] + sensor.noise * rng.standard_normal(int(returned.sum()))
    objects = scene.object_indices[hits.parts[returned]]
    # Intensity falls with range; car paint reflects more than asphalt and brick.
    intensity = np.clip(np.where(objects == BACKGROUND, 0.3, 0.6) * np.exp(-ranges / 60), 0, 1)
    points = np.concatenate((local[:, returned] * ranges, intensity[None])).T
    return StreetSweep(np.ascontiguousarray(points, np.float32), objects, world_from_lidar)


def _directions(sensor: LidarSensor) -> Float32[np.ndarray, "3 b a"]:
    elevation = np.radians(np.linspace(sensor.elevations[0], sensor.elevations[1], sensor.beams))[:, None]
    azimuth = (np.pi - 2 * np.pi * (np.arange(sensor.azimuth_steps) + 0.5) / sensor.azimuth_steps)[None]
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack((x, y, np.broadcast_to(np.sin(elevation), x.shape))).astype(np.float32)
