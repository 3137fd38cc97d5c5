"""Parts of the street, the scene that they make up, and the rays that meet it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int16

from sparsestreet.data.synthetic.shapes import Capsule, Shape, Vectors, rotated
from sparsestreet.data.synthetic.textures import Surface

BACKGROUND = -1
"""Object index of parts that belong to no annotated object."""

Pose = Float64[np.ndarray, "4 4"]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    shape: Shape
    surface: Surface
    frame_from_part: Pose
    """The frame is the object's while a model is built, and the world once the part stands in the street."""
    object_index: int = BACKGROUND


def placed(parts: list[Part], world_from_object: Pose, object_index: int = BACKGROUND) -> list[Part]:
    """Return the parts of an object, moved to the world."""
    return [
        replace(part, frame_from_part=world_from_object @ part.frame_from_part, object_index=object_index)
        for part in parts
    ]


def at(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """Return a pose at a position, turned by ``yaw`` radians about z.

    >>> at(1.0, 2.0, 0.0)[:3, 3].tolist()
    [1.0, 2.0, 0.0]
    """
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return pose


def axis_along_y(x: float, y: float, z: float) -> Pose:
    """Return a pose whose z axis is the frame's y axis, as for wheels on an axle."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    pose[:3, 3] = x, y, z
    return pose


def limb(start: Point, end: Point, radius: float, surface: Surface) -> Part:
    """Return a capsule whose axis runs from one point to another, meters."""
    a, b = np.array(start, np.float64), np.array(end, np.float64)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((np.cross(side, axis), side, axis), axis=1)
    pose[:3, 3] = (a + b) / 2
    return Part(Capsule(radius, length / 2.0), surface, pose)


_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_MARGIN = np.float32(5e-3)
"""Slack of all culling tests, meters: float32 rounds 250 m by 1.5e-5, and products of three such terms by less."""


@dataclass(frozen=True)
class Scene:
    parts: tuple[Part, ...]
    rotations: Float32[np.ndarray, "p 3 3"]
    """World from part."""
    centers: Float32[np.ndarray, "p 3"]
    half_extents: Float32[np.ndarray, "p 3"]
    corners: Float32[np.ndarray, "p 8 3"]
    """Corners of the bounding boxes, world frame."""
    half_axes: Float32[np.ndarray, "p 3 3"]
    """Columns are vectors from the center of each bounding box to the middle of its faces, world frame, meters."""
    object_indices: Int[np.ndarray, " p"]

    @staticmethod
    def of(parts: list[Part]) -> "Scene":
        poses = np.stack([part.frame_from_part for part in parts])
        half = np.stack([part.shape.half_extent for part in parts]).astype(np.float32)
        rotations = np.ascontiguousarray(poses[:, :3, :3], np.float32)
        centers = np.ascontiguousarray(poses[:, :3, 3], np.float32)
        corners = centers[:, None] + (_SIGNS * half[:, None]) @ rotations.transpose(0, 2, 1)
        objects = np.array([part.object_index for part in parts], np.int16)
        return Scene(tuple(parts), rotations, centers, half, corners, rotations * half[:, None], objects)

    def to_part(self, index: int, points: Float32[np.ndarray, "3 m"]) -> Float32[np.ndarray, "3 m"]:
        """Return world points in the frame of a part."""
        return rotated(self.rotations[index].T, points - self.centers[index][:, None])

    def turn_to_part(self, index: int, directions: Vectors) -> Vectors:
        return rotated(self.rotations[index].T, directions)

    def turn_to_world(self, index: int, directions: Vectors) -> Vectors:
        return rotated(self.rotations[index], directions)

    def distances(self, origin: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, " p"]:
        """Return a lower bound of the distance from a point to each part, meters."""
        local = np.einsum("pji,pj->pi", self.rotations, origin - self.centers)
        return np.linalg.norm(np.maximum(np.abs(local) - self.half_extents, 0), axis=1)

    def in_bundle(
        self, among: Int[np.ndarray, " c"], origin: Float32[np.ndarray, "3"], planes: Float32[np.ndarray, "k 3"]
    ) -> Int[np.ndarray, " d"]:
        """Return the parts that lie wholly outside none of the planes through ``origin`` (normals point inwards)."""
        # The support function of a box is the reach of its farthest corner along each normal.
        reach = np.abs(planes @ self.half_axes[among]).sum(2)
        heights = (self.centers[among] - origin) @ planes.T + reach
        return among[(heights >= -_MARGIN).all(1)]


@dataclass(frozen=True)
class SunView:
    """The scene as the sun sees it, projected to a plane in which every shadow ray is a point."""

    sun: Float32[np.ndarray, "3"]
    axes: Float32[np.ndarray, "3 3"]
    """Rows are two axes across the sunlight, and the direction towards the sun."""
    low: Float32[np.ndarray, "p 3"]
    high: Float32[np.ndarray, "p 3"]

    @staticmethod
    def of(scene: Scene, sun: Float32[np.ndarray, "3"]) -> "SunView":
        side = np.cross(sun, np.array([0, 0, 1], np.float32))
        side /= np.linalg.norm(side)
        axes = np.stack((side, np.cross(sun, side), sun)).astype(np.float32)
        seen = scene.corners @ axes.T
        return SunView(sun, axes, seen.min(1) - _MARGIN, seen.max(1) + _MARGIN)

    def blockers(self, seen: Vectors) -> Int[np.ndarray, " c"]:
        """Return parts that may lie between the sun and some of the points, which are in this view's coordinates."""
        low, high = seen.min(1), seen.max(1)
        beside = (self.low[:, :2] > high[:2]) | (self.high[:, :2] < low[:2])
        return np.flatnonzero(~beside.any(1) & (self.high[:, 2] > low[2]))


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
    """Return the nearest part along every ray."""
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
    """Return inward normals of up to four planes through the origin with all rays of the tile on one side.

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
    """Return whether the shadow ray from each point reaches the sun. All points lie on the convex part ``owner``.

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
