"""Colors of the surfaces that rays hit: sun with hard shadows, light of sky and ground, a mirrored sky, haze."""

import numpy as np
from jaxtyping import Float32, UInt8

from sparsestreet.data.synthetic.scene import Scene, SunView
from sparsestreet.data.synthetic.shapes import Scalars, Vectors
from sparsestreet.data.synthetic.sky import SUNLIGHT, Weather
from sparsestreet.data.synthetic.textures.appearance import column, mix
from sparsestreet.data.synthetic.tracer import NOTHING, Hits, Rays, sunlit

_HAZE_LENGTH = 900.0
"""Meters after which haze leaves 1/e of a surface's color."""
_HAZE = (0.62, 0.70, 0.80)
_STREET_MIRROR = (0.22, 0.21, 0.20)
"""Color that a mirror reflects below the roofs, from the other side of the street."""
_EXPOSURE = 0.62


def radiance(
    scene: Scene, view: SunView, weather: Weather, rays: Rays, hits: Hits, pixel_angle: float
) -> Float32[np.ndarray, "3 h w"]:
    """Returns linear RGB of every ray. ``pixel_angle`` is the angle between neighboring rays, radians."""
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
    """Returns the light from the points of one part towards the viewer."""
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
    """Returns the extents, along the axes, of the area that a pixel covers on a plane.

    A cone of width r around direction d covers r |a - n (d.a) / (d.n)| along an axis a of the plane with normal n. This
    is the gradient of the hit point's coordinate with respect to the ray.
    """
    cosine = (directions * normals).sum(0)
    cosine = np.where(np.abs(cosine) < 0.02, np.float32(-0.02), cosine)
    ratio = directions / cosine
    return radius * np.sqrt(np.maximum(1 - 2 * normals * ratio + ratio * ratio, 0))


def mirrored(weather: Weather, directions: Vectors, normals: Vectors, gloss: Scalars, lit: np.ndarray) -> Vectors:
    """Returns sky and sun mirrored in glossy surfaces (Schlick's Fresnel term); below roofs, the street's far side."""
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
    """Returns 8-bit sRGB (IEC 61966-2-1) after a shoulder that keeps bright walls from clipping.

    ``gains`` multiply the stored values of red, green and blue, before these are rounded and cut off at white.
    """
    exposed = np.maximum(linear * np.float32(_EXPOSURE), 0)
    exposed = exposed * (1 + exposed / 4) / (1 + exposed)
    exposed = np.clip(exposed * np.float32(1.45), 0, 1)
    encoded = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)
    if gains is not None:
        encoded = np.minimum(encoded * gains[:, None, None], 1)
    return np.ascontiguousarray(np.round(encoded * 255).astype(np.uint8).transpose(1, 2, 0))
