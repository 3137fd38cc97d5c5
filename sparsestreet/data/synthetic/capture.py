"""How a camera captures an instant: rays through its lens, shading of what they meet, and light over the exposure."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int16, UInt8

from sparsestreet.data.synthetic.settings import CAMERA_YAWS_DEGREES, StreetSettings
from sparsestreet.data.synthetic.shapes import Scalars, Vectors
from sparsestreet.data.synthetic.textures import SUNLIGHT, Weather, column, mix
from sparsestreet.data.synthetic.tracer import (
    BACKGROUND,
    NOTHING,
    Hits,
    Pose,
    Rays,
    Scene,
    SunView,
    at,
    first_hits,
    sunlit,
)
from sparsestreet.data.synthetic.world import World
from sparsestreet.geometry.lenses import undistort

_HAZE_LENGTH = 900.0
"""Meters after which haze leaves 1/e of a surface's color."""
_HAZE = (0.62, 0.70, 0.80)
_STREET_MIRROR = (0.22, 0.21, 0.20)
"""Color that a mirror reflects below the roofs, from the other side of the street."""
_EXPOSURE = 0.62


def radiance(
    scene: Scene, view: SunView, weather: Weather, rays: Rays, hits: Hits, pixel_angle: float
) -> Float32[np.ndarray, "3 h w"]:
    """Return linear RGB of every ray. ``pixel_angle`` is the angle between neighboring rays, radians."""
    directions = rays.directions.reshape(3, -1)
    parts, distances = hits.parts.ravel(), hits.distances.ravel()
    colors = np.empty(directions.shape, np.float32)
    order = np.argsort(parts, kind="stable")
    bounds = np.flatnonzero(np.diff(parts[order])) + 1
    for members in np.split(order, bounds):
        index = parts[members[0]]
        toward = directions[:, members]
        if index == NOTHING:
            colors[:, members] = weather.radiance(toward)
            continue
        distance = distances[members]
        shaded = _shade(scene, view, weather, int(index), rays.origin, toward, distance, pixel_angle)
        haze = np.float32(1) - np.exp(distance * np.float32(-1 / _HAZE_LENGTH))
        colors[:, members] = mix(shaded, column(_HAZE), haze)
    return colors.reshape(rays.directions.shape)


def _shade(
    scene: Scene,
    view: SunView,
    weather: Weather,
    index: int,
    origin: Float32[np.ndarray, "3"],
    directions: Vectors,
    distances: Scalars,
    pixel_angle: float,
) -> Vectors:
    """Return the light from the points of one part towards the viewer."""
    points = origin[:, None] + distances * directions
    part = scene.parts[index]
    local_directions, local_points = scene.turn_to_part(index, directions), scene.to_part(index, points)
    local_normals = part.shape.normals(local_points)
    footprints = _footprints(local_directions, local_normals, distances * np.float32(pixel_angle))
    appearance = part.surface.appearance(local_points, local_normals, footprints)
    normals = scene.turn_to_world(index, local_normals)
    lit = sunlit(scene, view, points, normals, index)
    slope = (normals * view.sun[:, None]).sum(0) * lit
    light = weather.ambient(normals) + column(SUNLIGHT) * slope
    return appearance.albedo * light + mirrored(weather, directions, normals, appearance.gloss, lit)


def _footprints(directions: Vectors, normals: Vectors, radius: Scalars) -> Vectors:
    """Return the extents, along the axes, of the area that a pixel covers on a plane.

    A cone of width r around direction d covers r |a - n (d.a) / (d.n)| along an axis a of the plane with normal n. This
    is the gradient of the hit point's coordinate with respect to the ray.
    """
    cosine = (directions * normals).sum(0)
    cosine = np.where(np.abs(cosine) < 0.02, np.float32(-0.02), cosine)
    ratio = directions / cosine
    return radius * np.sqrt(np.maximum(1 - 2 * normals * ratio + ratio * ratio, 0))


def mirrored(weather: Weather, directions: Vectors, normals: Vectors, gloss: Scalars, lit: np.ndarray) -> Vectors:
    """Return sky and sun mirrored in glossy surfaces (Schlick's Fresnel term); below roofs, the street's far side."""
    colors = np.zeros_like(directions)
    shiny = np.flatnonzero(gloss > 0.01)
    if len(shiny) == 0:
        return colors
    towards, normal = directions[:, shiny], normals[:, shiny]
    cosine = (towards * normal).sum(0)
    mirrored = towards - 2 * cosine * normal
    sky = weather.radiance(mirrored)
    street = np.clip((mirrored[2] - np.float32(0.25)) * 4, 0, 1)
    seen = mix(column(_STREET_MIRROR), np.minimum(sky, 3), street)
    fresnel = np.float32(0.12) + np.float32(0.88) * np.clip(1 + cosine, 0, 1) ** 5
    sun = np.maximum((mirrored * weather.sun[:, None]).sum(0), 0) ** 200 * lit[shiny]
    colors[:, shiny] = gloss[shiny] * (fresnel * seen + np.float32(2) * sun)
    return colors


def to_srgb(
    linear: Float32[np.ndarray, "3 h w"], gains: Float32[np.ndarray, "3"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return 8-bit sRGB (IEC 61966-2-1) after a shoulder that keeps bright walls from clipping.

    ``gains`` multiply the stored values of red, green and blue, before these are rounded and cut off at white.
    """
    exposed = np.maximum(linear * np.float32(_EXPOSURE), 0)
    exposed = exposed * (1 + exposed / 4) / (1 + exposed)
    exposed = np.clip(exposed * np.float32(1.45), 0, 1)
    encoded = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)
    if gains is not None:
        encoded = np.minimum(encoded * gains[:, None, None], 1)
    return np.ascontiguousarray(np.round(encoded * 255).astype(np.uint8).transpose(1, 2, 0))


_EGO_AXES_FROM_CAMERA = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
"""Columns are camera x (right), y (down), z (forward) in ego axes (x forward, y left, z up)."""
_MOUNT = (1.6, 0.0, 1.65)
"""Camera position on the ego car, meters."""


Window = tuple[slice, slice]
"""Rows and columns of an image, pixels."""
EVERYWHERE: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class StreetCamera:
    """A camera at an instant."""

    world_from_camera: Pose
    intrinsics: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    """Brown-Conrady k1, k2, p1, p2, k3; empty: a pinhole."""

    def rays(self, supersampling: int, window: Window = EVERYWHERE) -> Rays:
        """Return supersampling x supersampling evenly spread rays per pixel; a single ray goes through its center."""
        local = self._directions(supersampling, window)
        world = np.einsum("ij,jhw->ihw", self.world_from_camera[:3, :3], local)
        return Rays(self.world_from_camera[:3, 3].astype(np.float32), np.ascontiguousarray(world, np.float32))

    def axis_cosines(self, window: Window = EVERYWHERE) -> Float64[np.ndarray, "h w"]:
        """Return the depth along the optical axis per meter along the ray through each pixel's center."""
        return self._directions(1, window)[2]

    def _directions(self, supersampling: int, window: Window) -> Float64[np.ndarray, "3 a b"]:
        k = self.intrinsics
        focal_and_center = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        rows, columns = (range(size)[part] for size, part in zip((self.height, self.width), window, strict=True))
        within = tuple(slice(part.start * supersampling, part.stop * supersampling) for part in (rows, columns))
        return _directions(self.width, self.height, focal_and_center, self.distortion, supersampling)[:, *within]


def street_camera(settings: StreetSettings, index: int, world_from_ego: Pose) -> StreetCamera:
    """Return camera ``index`` of the rig."""
    ego_from_camera = at(*_MOUNT, yaw=float(np.radians(CAMERA_YAWS_DEGREES[index])))
    ego_from_camera[:3, :3] = ego_from_camera[:3, :3] @ _EGO_AXES_FROM_CAMERA
    focal = settings.width / 2 / np.tan(np.radians(settings.field_of_view) / 2)
    intrinsics = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1]])
    pose = world_from_ego @ ego_from_camera
    return StreetCamera(pose, intrinsics, settings.width, settings.height, tuple(settings.lens))


@lru_cache(maxsize=4)
def _directions(
    width: int, height: int, focal_and_center: tuple[float, ...], distortion: tuple[float, ...], supersampling: int
) -> Float64[np.ndarray, "3 a b"]:
    """Return unit vectors in the camera frame.

    The result is cached because all frames of a rig share it: Newton's method takes as long as tracing the rays.
    """
    fx, fy, cx, cy = focal_and_center
    x = ((np.arange(width * supersampling) + 0.5) / supersampling - cx) / fx
    y = ((np.arange(height * supersampling) + 0.5) / supersampling - cy) / fy
    y, x = np.meshgrid(y, x, indexing="ij")
    if distortion:
        imaged = torch.from_numpy(np.stack((x, y), -1))
        x, y = undistort(imaged, torch.tensor(distortion, dtype=torch.float64)).movedim(-1, 0).numpy()
    directions = np.stack((x, y, np.ones_like(x)))
    directions /= np.linalg.norm(directions, axis=0)
    directions.flags.writeable = False
    return directions


@dataclass(frozen=True)
class Sight:
    """Light of pixels, and the truth along the ray through each pixel's center."""

    linear: Float32[np.ndarray, "3 h w"]
    """RGB radiance, mean over the pixel."""
    depth: Float32[np.ndarray, "h w"]
    """Depth along the optical axis, meters; 0 in the sky."""
    object_indices: Int16[np.ndarray, "h w"]
    """Position in World.actors, or BACKGROUND."""
    sky: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Instant:
    """The street at a time, with its light."""

    scene: Scene
    sunlit: SunView
    weather: Weather
    actors: tuple[tuple[Pose, tuple[float, float, float]], ...]
    """World from object and the size of the box, meters, of every actor of the world."""

    @staticmethod
    def at(world: World, time: float) -> "Instant":
        """Return the street at ``time``, seconds."""
        scene = Scene.of(world.parts_at(time))
        actors = tuple((actor.pose(time), actor.model.size) for actor in world.actors)
        return Instant(scene, SunView.of(scene, world.weather.sun), world.weather, actors)

    def inside_an_actor(self, camera: StreetCamera, margin: float = 0.3) -> bool:
        """Whether the camera lies in, or within ``margin`` meters of, the box of an annotated object."""
        for pose, size in self.actors:
            local = np.linalg.inv(pose) @ camera.world_from_camera[:, 3]
            if (np.abs(local[:3]) < np.array(size) / 2 + margin).all():
                return True
        return False

    def actors_within(self, meters: float, camera: StreetCamera) -> list[int]:
        """Return positions in World.actors of actors at most ``meters`` from the camera, seen from above."""
        here = camera.world_from_camera[:2, 3]
        return [at for at, (pose, _) in enumerate(self.actors) if np.linalg.norm(pose[:2, 3] - here) <= meters]

    def seen_by(self, camera: StreetCamera, samples: int, window: Window = EVERYWHERE) -> Sight:
        """Return what the pixels of a window see, their light by samples x samples rays each."""
        rays = camera.rays(1, window)
        hits = first_hits(self.scene, rays)
        linear = self._radiance(camera, rays, hits, 1) if samples == 1 else self.light(camera, samples, window)
        sky = hits.parts == NOTHING
        depth = np.where(sky, 0, hits.distances * camera.axis_cosines(window)).astype(np.float32)
        objects = np.where(sky, BACKGROUND, self.scene.object_indices[hits.parts]).astype(np.int16)
        return Sight(linear, depth, objects, sky)

    def light(self, camera: StreetCamera, samples: int, window: Window = EVERYWHERE) -> Float32[np.ndarray, "3 h w"]:
        """Return the light of the same pixels alone."""
        rays = camera.rays(samples, window)
        return self._radiance(camera, rays, first_hits(self.scene, rays), samples)

    def _radiance(self, camera: StreetCamera, rays: Rays, hits: Hits, samples: int) -> Float32[np.ndarray, "3 h w"]:
        pixel = 1 / float(camera.intrinsics[0, 0]) / samples
        linear = radiance(self.scene, self.sunlit, self.weather, rays, hits, pixel)
        height, width = hits.parts.shape
        return linear.reshape(3, height // samples, samples, width // samples, samples).mean((2, 4))


_STRIPS = 48
"""Rows of a strip share an instant, which is at most a 96th of the readout off: 0.3 of 30 ms, 0.1 pixels at 5 m."""
_NEAR = 5.0
"""Meters; what is passed this close moves about a pixel between two moments of an exposure."""


def captured(
    settings: StreetSettings,
    instant_at: Callable[[float], Instant],
    camera_at: Callable[[float], StreetCamera],
    exposure: float = 0.0,
) -> Sight:
    """Return what a camera with the settings' readout sees, each strip of rows or columns at its own instant.

    Args:
        settings: ``readout`` and its direction, ``supersampling`` and, for the number of moments, ``ego_speed``.
        instant_at: the street, by seconds from the middle of the readout.
        camera_at: the camera where it is then.
        exposure: seconds over which light is averaged, as of a sensor: before it becomes stored values. Depth and
            objects are those of its middle.
    """
    camera = camera_at(0.0)
    reads_columns = settings.readout_direction in ("left", "right")
    sights = []
    for window, middle in _strips(settings, camera):
        sight = instant_at(middle).seen_by(camera_at(middle), settings.supersampling, window)
        if exposure:
            linear = np.zeros_like(sight.linear)
            moments = _moments(settings, camera, exposure)
            for moment in moments:
                time = middle + moment
                linear += instant_at(time).light(camera_at(time), settings.supersampling, window)
            sight = Sight(linear / np.float32(len(moments)), sight.depth, sight.object_indices, sight.sky)
        sights.append(sight)
    axis = -1 if reads_columns else -2
    return Sight(*(np.concatenate([getattr(sight, field.name) for sight in sights], axis) for field in fields(Sight)))


def _strips(settings: StreetSettings, camera: StreetCamera) -> list[tuple[Window, float]]:
    """Return the image's strips from its top or left, and the middle of their exposure, seconds."""
    if not settings.readout:
        return [(EVERYWHERE, 0.0)]
    reads_columns = settings.readout_direction in ("left", "right")
    count = camera.width if reads_columns else camera.height
    sign = 1 if settings.readout_direction in ("top", "left") else -1
    strips = []
    for start, stop in pairwise(np.linspace(0, count, min(_STRIPS, count) + 1).round().astype(int).tolist()):
        part, everything = slice(start, stop), slice(None)
        window = (everything, part) if reads_columns else (part, everything)
        strips.append((window, sign * settings.readout * ((start + stop) / 2 / count - 0.5)))
    return strips


def _moments(settings: StreetSettings, camera: StreetCamera, exposure: float) -> list[float]:
    """Return the middles of equal parts of an exposure, seconds from its own."""
    moved = float(camera.intrinsics[0, 0]) * settings.ego_speed * exposure / _NEAR
    count = int(np.clip(np.ceil(moved), 3, 9))
    return [exposure * ((place + 0.5) / count - 0.5) for place in range(count)]
