"""First hits of ray bundles, and shadow rays towards the sun."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int, Int16

from sparsestreet.data.synthetic.scene import Scene, SunView
from sparsestreet.data.synthetic.shapes import Vectors, rotated

NOTHING = np.int16(-1)
"""Part index of a ray that leaves the street."""

_TILE = 64
"""Side of the bundles that share one list of candidate parts, in rays. It is small enough for the cache and for
culling, and large enough that NumPy's cost per call does not matter."""
_LIFT = np.float32(2e-3)
"""Height above the surface at which shadow rays start, meters; more than the rounding of a hit 250 m away."""


@dataclass(frozen=True)
class Rays:
    """A grid of rays from one point, such as a camera's pixels or a lidar's beams and azimuth steps."""

    origin: Float32[np.ndarray, "3"]
    directions: Float32[np.ndarray, "3 h w"]
    """Unit length, world frame."""


@dataclass(frozen=True)
class Hits:
    distances: Float32[np.ndarray, "h w"]
    """Meters along the ray; infinity if nothing was hit."""
    parts: Int16[np.ndarray, "h w"]
    """Index of the part that was hit, or NOTHING."""


def first_hits(scene: Scene, rays: Rays) -> Hits:
    """Returns the nearest part along every ray."""
    _, height, width = rays.directions.shape
    distances = np.empty((height, width), np.float32)
    parts = np.empty((height, width), np.int16)
    nearness = scene.distances(rays.origin)
    nearest_first = np.argsort(nearness, kind="stable")
    in_view = scene.in_bundle(nearest_first, rays.origin, _bounding_planes(rays.directions))
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            window = (slice(top, top + _TILE), slice(left, left + _TILE))
            tile = rays.directions[:, window[0], window[1]]
            shape = tile.shape[1:]
            nearest, hit = _trace_tile(scene, rays.origin, tile, in_view, nearness)
            distances[window], parts[window] = nearest.reshape(shape), hit.reshape(shape)
    return Hits(distances, parts)


def _trace_tile(
    scene: Scene,
    origin: Float32[np.ndarray, "3"],
    tile: Float32[np.ndarray, "3 a b"],
    in_view: Int[np.ndarray, " c"],
    nearness: Float32[np.ndarray, " p"],
) -> tuple[Float32[np.ndarray, " n"], Int16[np.ndarray, " n"]]:
    directions = np.ascontiguousarray(tile.reshape(3, -1))
    nearest = np.full(directions.shape[1], np.inf, np.float32)
    hit = np.full(directions.shape[1], NOTHING, np.int16)
    for index in scene.in_bundle(in_view, origin, _bounding_planes(tile)).tolist():
        if nearness[index] > nearest.max():
            break
        local_origin = scene.to_part(index, origin[:, None])
        distance = scene.parts[index].shape.enter(local_origin, scene.turn_to_part(index, directions))
        closer = distance < nearest
        np.copyto(nearest, distance, where=closer)
        np.copyto(hit, np.int16(index), where=closer)
    return nearest, hit


def _bounding_planes(tile: Float32[np.ndarray, "3 a b"]) -> Float32[np.ndarray, "k 3"]:
    """Returns inward normals of up to four planes through the origin with all rays of the tile on one side.

    Sides of a lidar's tile are cones, and a lens bends those of a camera's tile. So a plane that would cut off rays is
    turned until it does not, or omitted if the tile is too wide for that.
    """
    corners = tile[:, [0, 0, -1, -1], [0, -1, -1, 0]].T
    normals = np.cross(corners, np.roll(corners, -1, axis=0))
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    middle, rays = tile.mean((1, 2)), tile.reshape(3, -1)
    normals *= np.sign(normals @ middle)[:, None]
    ahead = rotated(middle[None], rays)
    if ahead.min() > 0:
        normals += (-rotated(normals, rays) / ahead).max(1, initial=0)[:, None] * middle
    lowest = rotated(normals, rays).min(1, initial=np.inf)
    return np.ascontiguousarray(normals[lowest >= -1e-6], np.float32)


def sunlit(scene: Scene, view: SunView, points: Vectors, normals: Vectors, owner: int) -> Bool[np.ndarray, " n"]:
    """Returns whether the shadow ray from each point reaches the sun. All points lie on the convex part ``owner``.

    ``normals`` are outward and in the world frame, as ``points`` are.
    """
    lit = (normals * view.sun[:, None]).sum(0) > 0
    facing = np.flatnonzero(lit)
    if len(facing) > 0:
        lit[facing] = ~_blocked(scene, view, points[:, facing] + _LIFT * normals[:, facing], owner)
    return lit


def _blocked(scene: Scene, view: SunView, points: Vectors, owner: int) -> Bool[np.ndarray, " n"]:
    seen = rotated(view.axes, points)
    # When sorted along one axis of the sun's view, the points that a part may shade form one short run.
    order = np.argsort(seen[1])
    points, seen = points[:, order], seen[:, order]
    dark = np.zeros(points.shape[1], bool)
    candidates = view.blockers(seen)
    starts = np.searchsorted(seen[1], view.low[candidates, 1])
    stops = np.searchsorted(seen[1], view.high[candidates, 1])
    for index, start, stop in zip(candidates.tolist(), starts.tolist(), stops.tolist(), strict=True):
        if index == owner or start == stop:  # a convex part does not shade its own lit side
            continue
        low, high, run = view.low[index], view.high[index], slice(start, stop)
        across, along = seen[0, run], seen[2, run]
        near = across > low[0]
        near &= across < high[0]
        near &= along < high[2]
        near &= ~dark[run]
        rays = start + np.flatnonzero(near)
        if len(rays) == 0:
            continue
        sun = np.repeat(scene.turn_to_part(index, view.sun[:, None]), len(rays), axis=1)
        distance = scene.parts[index].shape.enter(scene.to_part(index, points[:, rays]), sun)
        dark[rays[np.isfinite(distance)]] = True
    blocked = np.empty_like(dark)
    blocked[order] = dark
    return blocked
