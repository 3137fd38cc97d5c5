"""Convex solids in their own frames, and the distances at which rays enter them.

Arrays hold one coordinate per row ([3, n]), so that each coordinate is contiguous. Directions have unit length and
distances are meters. A ray that misses, starts inside or points away has distance infinity.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

Vectors = Float32[np.ndarray, "3 n"]
Scalars = Float32[np.ndarray, " n"]
Vector = Float32[np.ndarray, "3"]

_TINY = np.float32(1e-12)


def rotated(rows: Float32[np.ndarray, "k 3"], vectors: Float32[np.ndarray, "3 m"]) -> Float32[np.ndarray, "k m"]:
    """Return rows @ vectors without matmul, whose BLAS starts threads for products too small to gain from them."""
    return np.einsum("kj,jm->km", rows, vectors)


@runtime_checkable
class Shape(Protocol):
    """A convex solid around the origin of its frame."""

    @property
    def half_extent(self) -> Vector:
        """Half sides of a box around the origin that contains the solid, meters."""
        ...

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        """Return the distance at which each ray enters; ``origins`` has a column per ray or one for all."""
        ...

    def normals(self, points: Vectors) -> Vectors:
        """Return outward unit normals at points on the surface."""
        ...


def _entered(near: Scalars, far: Scalars) -> Scalars:
    return np.where((near <= far) & (near > 0), near, np.float32(np.inf))


def _away_from_zero(values: np.ndarray) -> np.ndarray:
    """Return the values with magnitudes of at least 1e-12, so that they can divide."""
    return np.where(np.abs(values) < _TINY, _TINY, values)


def _slab(origins: np.ndarray, directions: np.ndarray, half: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances at which rays enter and leave |coordinate| <= half (Kay and Kajiya)."""
    inverse = np.float32(1) / _away_from_zero(directions)
    center = -origins * inverse
    reach = np.float32(half) * np.abs(inverse)
    return center - reach, center + reach


@dataclass(frozen=True)
class Box:
    """A box: |x|, |y|, |z| <= half_extent, three slabs."""

    half_extent: Vector

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        near, far = _slab(origins, directions, self.half_extent[:, None])
        return _entered(near.max(0), far.min(0))

    def normals(self, points: Vectors) -> Vectors:
        face = (np.abs(points) - self.half_extent[:, None]).argmax(0)
        normals = np.zeros_like(points)
        columns = np.arange(points.shape[1])
        normals[face, columns] = np.sign(points[face, columns])
        return normals


@dataclass(frozen=True)
class Polytope:
    """A convex polytope {p: normals_out @ p <= offsets}, bounded by ``half_extent``."""

    normals_out: Float32[np.ndarray, "k 3"]
    """Unit length."""
    offsets: Float32[np.ndarray, " k"]
    half_extent: Vector

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        slope = _away_from_zero(rotated(self.normals_out, directions))
        distance = (self.offsets[:, None] - rotated(self.normals_out, origins)) / slope
        entering = slope < 0
        near = np.where(entering, distance, np.float32(-np.inf)).max(0)
        far = np.where(entering, np.float32(np.inf), distance).min(0)
        return _entered(near, far)

    def depths(self, points: Vectors) -> Float32[np.ndarray, "k n"]:
        """Return the depth of each point inside each face plane, meters (negative outside)."""
        return self.offsets[:, None] - rotated(self.normals_out, points)

    def normals(self, points: Vectors) -> Vectors:
        return np.ascontiguousarray(self.normals_out[self.depths(points).argmin(0)].T)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid (x/a)^2 + (y/b)^2 + (z/c)^2 <= 1 with half axes ``half_extent``."""

    half_extent: Vector

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        scale = (np.float32(1) / self.half_extent)[:, None]
        origins, directions = origins * scale, directions * scale
        a = (directions * directions).sum(0)
        middle = -(origins * directions).sum(0) / a
        # Uses the point closest to the center instead of b^2 - 4ac, which loses all digits in float32 at far origins.
        closest = origins + middle * directions
        room = np.float32(1) - (closest * closest).sum(0)
        half_chord = np.sqrt(np.maximum(room, 0) / a)
        return np.where(room > 0, _entered(middle - half_chord, middle + half_chord), np.float32(np.inf))

    def normals(self, points: Vectors) -> Vectors:
        return _unit(points / np.square(self.half_extent)[:, None])


@dataclass(frozen=True)
class Cylinder:
    """A cylinder: x^2 + y^2 <= radius^2, |z| <= half_length."""

    radius: float
    half_length: float

    @property
    def half_extent(self) -> Vector:
        return np.array([self.radius, self.radius, self.half_length], np.float32)

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        near, far = _round_wall(origins, directions, self.radius)
        cap_near, cap_far = _slab(origins[2], directions[2], self.half_length)
        return _entered(np.maximum(near, cap_near), np.minimum(far, cap_far))

    def normals(self, points: Vectors) -> Vectors:
        radial = np.hypot(points[0], points[1])
        cap = np.abs(points[2]) - np.float32(self.half_length) > radial - np.float32(self.radius)
        side = points / np.maximum(radial, _TINY)
        side[2] = 0
        lid = np.zeros_like(points)
        lid[2] = np.sign(points[2])
        return np.where(cap, lid, side)


@dataclass(frozen=True)
class Capsule:
    """A capsule: all points within ``radius`` of the segment |z| <= half_length on the z axis."""

    radius: float
    half_length: float

    @property
    def half_extent(self) -> Vector:
        return np.array([self.radius, self.radius, self.half_length + self.radius], np.float32)

    def enter(self, origins: Float32[np.ndarray, "3 m"], directions: Vectors) -> Scalars:
        # The union is convex, so this is the first entry into the wall between the caps or into one of the balls.
        near, far = _round_wall(origins, directions, self.radius)
        wall = np.where(near < far, near, np.float32(np.inf))
        z = origins[2] + np.where(np.isfinite(wall), wall, 0) * directions[2]
        wall = np.where((np.abs(z) <= self.half_length) & (wall > 0), wall, np.float32(np.inf))
        ball = Ellipsoid(np.full(3, self.radius, np.float32))
        for end in (-self.half_length, self.half_length):
            shifted = origins - np.array([[0], [0], [end]], np.float32)
            wall = np.minimum(wall, ball.enter(shifted, directions))
        # For a ray that starts inside, the branches above may still report a later inner surface.
        inside = self._distance_to_axis(origins) < self.radius
        return np.where(inside, np.float32(np.inf), wall)

    def _distance_to_axis(self, points: Float32[np.ndarray, "3 m"]) -> Float32[np.ndarray, " m"]:
        beyond = points[2] - np.clip(points[2], -self.half_length, self.half_length)
        return np.sqrt(points[0] ** 2 + points[1] ** 2 + beyond**2)

    def normals(self, points: Vectors) -> Vectors:
        nearest = np.clip(points[2], -self.half_length, self.half_length)
        return _unit(np.stack((points[0], points[1], points[2] - nearest)))


def _round_wall(origins: Float32[np.ndarray, "3 m"], directions: Vectors, radius: float) -> tuple[Scalars, Scalars]:
    """Return where rays enter and leave the infinite cylinder about z; an empty interval for rays that miss."""
    a = np.maximum(directions[0] ** 2 + directions[1] ** 2, _TINY)
    middle = -(origins[0] * directions[0] + origins[1] * directions[1]) / a
    x, y = origins[0] + middle * directions[0], origins[1] + middle * directions[1]
    room = np.float32(radius) ** 2 - x * x - y * y
    half_chord = np.sqrt(np.maximum(room, 0) / a)
    far = np.where(room > 0, middle + half_chord, np.float32(-np.inf))
    return middle - half_chord, far


def _unit(vectors: Vectors) -> Vectors:
    return vectors / np.maximum(np.sqrt((vectors * vectors).sum(0)), _TINY)


def box(length: float, width: float, height: float) -> Box:
    """Return a box with the given full sides along x, y, z, meters.

    >>> side = box(4.0, 2.0, 1.5)
    >>> side.enter(np.float32([[-5], [0], [0]]), np.float32([[1], [0], [0]])).tolist()
    [3.0]
    """
    return Box(np.array([length, width, height], np.float32) / 2)


def extrusion(profile: list[tuple[float, float]], bottom_width: float, top_width: float) -> Polytope:
    """Return a solid with a convex profile in x and z, and the given widths at its lowest and highest z.

    The profile is counter-clockwise as seen from -y.
    """
    corners = np.array(profile, np.float64)
    edges = np.roll(corners, -1, axis=0) - corners
    out = np.stack((edges[:, 1], np.zeros(len(edges)), -edges[:, 0]), axis=1)
    points = np.insert(corners, 1, 0.0, axis=1)
    low, high = corners[:, 1].min(), corners[:, 1].max()
    lean = (bottom_width - top_width) / 2 / (high - low)
    sides = np.array([[0, 1, lean], [0, -1, lean]])
    out, points = np.concatenate((out, sides)), np.concatenate((points, [[0, bottom_width / 2, low]] * 2))
    points[-1, 1] *= -1
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    extent = np.abs(points).max(0)
    extent[1] = max(bottom_width, top_width) / 2
    return Polytope(out.astype(np.float32), (out * points).sum(1).astype(np.float32), extent.astype(np.float32))
