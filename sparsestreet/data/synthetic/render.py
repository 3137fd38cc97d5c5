"""Render one frame of the street: pictures, exact truth per pixel, and the lidar's turn."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, UInt8

from sparsestreet.data.synthetic.capture import Instant, Sight, StreetCamera, captured, mirrored, street_camera, to_srgb
from sparsestreet.data.synthetic.settings import LidarSensor, StreetSettings
from sparsestreet.data.synthetic.textures import Weather, column, stream
from sparsestreet.data.synthetic.tracer import BACKGROUND, Pose, Rays, Scene, at, first_hits
from sparsestreet.data.synthetic.world import World

_SPOTS = 3
_OPACITY = 0.95
_LIGHT = 0.04
"""What reaches the sensor through a spot, linear."""
_SOFT = 0.25
"""Of the radius, on both sides of it: over this much a spot fades."""


def dirt_opacity(settings: StreetSettings, camera: int) -> Float32[np.ndarray, "h w"] | None:
    """Return the share of each pixel's light that dirt takes; None: the camera is clean.

    Three spots of one size, away from each other and from the border. Where they take half of the light they cover
    ``settings.dirt`` of the image.
    """
    if not settings.dirt or camera > 0:
        return None
    width, height = settings.width, settings.height
    radius = np.sqrt(settings.dirt * width * height / (np.pi * _SPOTS))
    draw, centers = stream(settings.seed, "dirt"), np.empty((0, 2))
    reach = np.minimum(1.3 * radius, (0.45 * width, 0.45 * height))
    while len(centers) < _SPOTS:
        center = draw.uniform(reach, (width - reach[0], height - reach[1]))
        if len(centers) == 0 or np.linalg.norm(centers - center, axis=1).min() > 2.6 * radius:
            centers = np.vstack((centers, center))
    y, x = np.mgrid[:height, :width] + 0.5
    distances = np.hypot(x - centers[:, 0, None, None], y - centers[:, 1, None, None]).min(0) / radius
    return (_OPACITY * np.clip((1 + _SOFT - distances) / (2 * _SOFT), 0, 1)).astype(np.float32)


def behind_dirt(sight: Sight, opacity: Float32[np.ndarray, "h w"]) -> Sight:
    """Return what a camera sees through the dirt; depth and objects are those of the street."""
    return replace(sight, linear=sight.linear * (1 - opacity) + np.float32(_LIGHT) * opacity)


_SMOOTH = 0.5
"""Seconds over which the steps of a walk are averaged, as a camera's control reacts."""


def recorded_gains(settings: StreetSettings, frame: int, camera: int) -> Float32[np.ndarray, "3"] | None:
    """Return factors of an image's stored red, green and blue; None if the settings have neither effect.

    They multiply sRGB values, not light: a learned gain of stored colors can undo them but for rounding and white.
    """
    if not settings.exposure_walk and not settings.white_balance:
        return None
    brightness = exposure_walk(settings, camera)[frame] * np.log(2)
    return np.exp(brightness + _tints(settings)[camera]).astype(np.float32)


def exposure_walk(settings: StreetSettings, camera: int) -> Float64[np.ndarray, " f"]:
    """Return a camera's exposure in each frame, EV: mean 0 and the standard deviation of the settings.

    In a drive of one frame it is 0.
    """
    count = settings.num_frames
    window = np.hanning(2 + 2 * max(1, round(_SMOOTH * settings.frame_rate)))[1:-1]
    steps = stream(settings.seed, f"exposure {camera}").standard_normal(count + len(window))
    walk = np.cumsum(np.convolve(steps, window, "same"))[:count]
    walk -= walk.mean()
    return walk * (settings.exposure_walk / max(walk.std(), 1e-12))


def _tints(settings: StreetSettings) -> Float64[np.ndarray, "cameras 3"]:
    """Return the logarithms of the constant gains: 0 on average over cameras, and over channels."""
    drawn = stream(settings.seed, "white balance").standard_normal((settings.num_cameras, 3))
    drawn -= drawn.mean(0)
    drawn -= drawn.mean(1, keepdims=True)
    return drawn * (settings.white_balance / max(drawn.std(), 1e-12))


_PAINT = (0.03, 0.03, 0.035)
_GLOSS = 0.5
_BULGE = 0.25
"""Sideways slope of the hood at the image's borders; its middle is flat."""
_FALL = 0.05
"""Its slope towards the road ahead."""


def hood_coverage(settings: StreetSettings, camera: int) -> Float32[np.ndarray, "h w"] | None:
    """Return the share of each pixel that the hood covers, ``settings.hood`` on average; None: the camera sees none.

    Its edge is a parabola, higher in the middle of the image than at the sides.
    """
    if not settings.hood or (camera > 0 and settings.hood_cameras == "front"):
        return None
    across = (np.arange(settings.width) + 0.5) / settings.width * 2 - 1
    # The mean of across^2 is 1/3.
    edge = settings.height * (1 - settings.hood * (1.1 - 0.3 * across**2))
    return np.clip(np.arange(1, settings.height + 1)[:, None] - edge, 0, 1).astype(np.float32)


def behind_hood(sight: Sight, coverage: Float32[np.ndarray, "h w"], camera: StreetCamera, weather: Weather) -> Sight:
    """Return what a camera sees with the hood in front: neither street nor sky where half of a pixel is covered."""
    covered = coverage >= 0.5
    linear = sight.linear + coverage * (_hood(camera, weather) - sight.linear)
    objects = np.where(covered, np.int16(BACKGROUND), sight.object_indices)
    return replace(
        sight,
        linear=linear,
        depth=np.where(covered, np.float32(0), sight.depth),
        object_indices=objects,
        sky=sight.sky & ~covered,
    )


def _hood(camera: StreetCamera, weather: Weather) -> Float32[np.ndarray, "3 h w"]:
    """Return the hood's light: dark paint in the shade, in which sky and street are mirrored."""
    towards = camera.rays(1).directions
    across = np.broadcast_to((np.arange(camera.width) + 0.5) / camera.width * 2 - 1, towards.shape[1:])
    local = np.stack((_BULGE * across, np.full_like(across, -1), np.full_like(across, _FALL)))
    normals = np.einsum("ij,jhw->ihw", camera.world_from_camera[:3, :3], local / np.linalg.norm(local, axis=0))
    directions, normals = (some.reshape(3, -1).astype(np.float32) for some in (towards, normals))
    shade, gloss = np.zeros(directions.shape[1], bool), np.full(directions.shape[1], _GLOSS, np.float32)
    light = column(_PAINT) * weather.ambient(normals) + mirrored(weather, directions, normals, gloss, shade)
    return light.reshape(towards.shape)


_READ = 0.002
_SHOT = 0.01
"""Noise of the sensor in linear light: its square is _READ^2 + _SHOT^2 times the light."""


def at_night(settings: StreetSettings, sight: Sight, frame: int, camera: int) -> Sight:
    """Return what the sensor records of 2^-night of the light; the noise of each image is its own."""
    if not settings.night:
        return sight
    dark = sight.linear * np.float32(2.0**-settings.night)
    drawn = stream(settings.seed, f"night {frame} {camera}").standard_normal(dark.shape, dtype=np.float32)
    return replace(sight, linear=dark + drawn * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(dark, 0)))


_AHEAD = 0.9
"""Meters ahead of the rear axle, in the middle of the roof."""


@dataclass(frozen=True)
class StreetSweep:
    points: Float32[np.ndarray, "n 4"]
    """x, y, z (meters, lidar frame: x forward, y left, z up) and intensity in [0, 1]; first returns with noise."""
    object_indices: Int16[np.ndarray, " n"]
    world_from_lidar: Pose


def sweep(settings: StreetSettings, scene: Scene, world_from_ego: Pose, frame: int) -> StreetSweep:
    """Return one turn of the sensor; ``frame`` only seeds dropout and noise."""
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
    """Render all images, each at its own instant, and the lidar and boxes of frame ``index``."""
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
    """Return what a camera records of a frame, at its own instant."""
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


def developed(camera: StreetCamera, sight: Sight, gains: Float32[np.ndarray, "3"] | None = None) -> StreetImage:
    """Return the picture of what a camera saw."""
    return StreetImage(camera, to_srgb(sight.linear, gains), sight.depth, sight.object_indices, sight.sky)
