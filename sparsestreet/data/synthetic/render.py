"""Renders one frame of the street: pictures, exact truth per pixel, and the lidar's turn."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8

from sparsestreet.data.synthetic.cameras import StreetCamera, street_camera
from sparsestreet.data.synthetic.capture import captured
from sparsestreet.data.synthetic.dirt import behind_dirt, dirt_opacity
from sparsestreet.data.synthetic.exposure import recorded_gains
from sparsestreet.data.synthetic.hood import behind_hood, hood_coverage
from sparsestreet.data.synthetic.instant import Instant, Sight
from sparsestreet.data.synthetic.lidar import StreetSweep, sweep
from sparsestreet.data.synthetic.night import at_night
from sparsestreet.data.synthetic.parts import Pose
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.shading import to_srgb
from sparsestreet.data.synthetic.world import World


@dataclass(frozen=True)
class StreetImage:
    """A picture and the truth along the ray through each pixel's center."""

    camera: StreetCamera
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    """Depth along the optical axis, meters; 0 in the sky."""
    object_indices: Int16[np.ndarray, "h w"]
    """Position in World.actors, or BACKGROUND."""
    sky: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class StreetFrame:
    index: int
    world_from_ego: Pose
    images: tuple[StreetImage, ...]
    sweep: StreetSweep
    actor_poses: tuple[Pose, ...]
    """World from object of every actor of the world."""


def render_frame(settings: StreetSettings, world: World, index: int) -> StreetFrame:
    """Renders all images, each at its own instant, and the lidar and boxes of frame ``index``."""
    time = index / settings.frame_rate
    # Cameras that fire together share the instants of their strips.
    instant_at = lru_cache(maxsize=64)(lambda seconds: Instant.at(world, seconds))
    instant, ego = instant_at(time), world.ego.pose(time)
    images = (_recorded(settings, world, instant_at, index, camera) for camera in range(settings.num_cameras))
    return StreetFrame(
        index=index,
        world_from_ego=ego,
        images=tuple(images),
        sweep=sweep(settings, instant.scene, ego, index),
        actor_poses=tuple(pose for pose, _ in instant.actors),
    )


def _recorded(
    settings: StreetSettings, world: World, instant_at: Callable[[float], Instant], frame: int, camera: int
) -> StreetImage:
    """Returns what a camera records of a frame, at its own instant."""
    time = settings.image_time(frame, camera)

    def camera_at(seconds: float) -> StreetCamera:
        return street_camera(settings, camera, world.ego.pose(time + seconds))

    mounted = camera_at(0.0)
    sight = captured(settings, lambda seconds: instant_at(time + seconds), camera_at, settings.shutter_time)
    coverage = hood_coverage(settings, camera)
    if coverage is not None:
        sight = behind_hood(sight, coverage, mounted, world.weather)
    dirt = dirt_opacity(settings, camera)
    if dirt is not None:
        sight = behind_dirt(sight, dirt)
    return developed(mounted, at_night(settings, sight, frame, camera), recorded_gains(settings, frame, camera))


def render_image(settings: StreetSettings, instant: Instant, camera: StreetCamera) -> StreetImage:
    """Renders what a camera sees at an instant; of the settings it uses only the number of rays per pixel."""
    return developed(camera, instant.seen_by(camera, settings.supersampling))


def developed(camera: StreetCamera, sight: Sight, gains: Float32[np.ndarray, "3"] | None = None) -> StreetImage:
    """Returns the picture of what a camera saw."""
    return StreetImage(camera, to_srgb(sight.linear, gains), sight.depth, sight.object_indices, sight.sky)
