"""Car bodies with lights, seams and arches; cabins with windows; wheels with rims. All in the part's own frame."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.coverage import beyond, strip
from sparsestreet.data.synthetic.shapes import Polytope
from sparsestreet.data.synthetic.textures.appearance import Appearance, Color, Scalars, Vectors, column, mix

PLASTIC = (0.025, 0.025, 0.028)
CAR_GLASS = (0.02, 0.025, 0.03)


@dataclass(frozen=True)
class BodyPaint:
    """Lower body: x forward, z measured from the part's center. Lengths in meters."""

    color: Color
    half_length: float
    half_width: float
    sill: float
    """Height below which the sides are dark plastic."""
    light: float
    """Height of the lamps' centers."""
    axles: tuple[float, float]
    """x of the front and the rear axle."""
    axle_height: float
    arch: float
    """Radius of the wheel arches."""
    seams: tuple[float, ...]
    """x of the door edges."""

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        albedo = np.repeat(column(self.color), points.shape[1], axis=1)
        gloss = np.full(points.shape[1], 0.35, np.float32)
        side, front, rear = np.abs(normals[1]) > 0.7, normals[0] > 0.6, normals[0] < -0.6
        for place, paint in ((side, self._side), (front, self._front), (rear, self._rear)):
            if place.any():
                albedo[:, place], gloss[place] = paint(albedo[:, place], points[:, place], footprints[:, place])
        return Appearance(albedo, gloss)

    def _side(self, albedo: Vectors, points: Vectors, footprints: Vectors) -> tuple[Vectors, Scalars]:
        x, _, z = points
        fx, _, fz = footprints
        dark = 1 - beyond(z, self.sill, fz)
        for axle in self.axles:
            radius = np.hypot(x - np.float32(axle), z - np.float32(self.axle_height))
            dark = np.maximum(dark, 1 - beyond(radius, self.arch, np.maximum(fx, fz)))
        for seam in self.seams:
            above_sill = beyond(z, self.sill, fz)
            dark = np.maximum(dark, strip(x, seam - 0.012, seam + 0.012, fx) * above_sill * np.float32(0.8))
            handle = strip(x, seam + 0.08, seam + 0.26, fx) * strip(z, self.light - 0.01, self.light + 0.035, fz)
            dark = np.maximum(dark, handle * np.float32(0.7))
        return mix(albedo, column(PLASTIC), dark), np.float32(0.35) * (1 - dark)

    def _front(self, albedo: Vectors, points: Vectors, footprints: Vectors) -> tuple[Vectors, Scalars]:
        y, z, fy, fz = np.abs(points[1]), points[2], footprints[1], footprints[2]
        edge = self.half_width
        grille = strip(y, -0.1, edge * 0.52, fy) * strip(z, self.light - 0.09, self.light + 0.06, fz)
        bumper = 1 - beyond(z, self.sill + 0.04, fz)
        albedo = mix(albedo, column(PLASTIC), np.maximum(grille, bumper))
        lamp = strip(y, edge * 0.58, edge * 0.95, fy) * strip(z, self.light - 0.07, self.light + 0.07, fz)
        albedo = mix(albedo, column((0.85, 0.86, 0.84)), lamp)
        return self._plate(albedo, y, z, fy, fz), np.float32(0.35) * (1 - bumper)

    def _rear(self, albedo: Vectors, points: Vectors, footprints: Vectors) -> tuple[Vectors, Scalars]:
        y, z, fy, fz = np.abs(points[1]), points[2], footprints[1], footprints[2]
        edge = self.half_width
        bumper = 1 - beyond(z, self.sill + 0.04, fz)
        albedo = mix(albedo, column(PLASTIC), bumper)
        lamp = strip(y, edge * 0.62, edge * 0.97, fy) * strip(z, self.light - 0.09, self.light + 0.11, fz)
        albedo = mix(albedo, column((0.45, 0.012, 0.012)), lamp)
        return self._plate(albedo, y, z, fy, fz), np.float32(0.35) * (1 - bumper)

    def _plate(self, albedo: Vectors, y: Scalars, z: Scalars, fy: Scalars, fz: Scalars) -> Vectors:
        plate = strip(y, -0.3, 0.26, fy) * strip(z, self.light - 0.24, self.light - 0.12, fz)
        return mix(albedo, column((0.75, 0.75, 0.68)), plate)


@dataclass(frozen=True)
class Cabin:
    """Painted pillars and roof around glass; every steep face is a pane inset by ``pillar`` meters."""

    color: Color
    shape: Polytope
    pillar: float
    posts: tuple[float, ...]
    """x of the posts between side windows."""

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        # The smallest depth belongs to the point's own face; the second smallest is the distance to the nearest edge.
        rim = np.partition(self.shape.depths(points), 1, axis=0)[1]
        pane = beyond(rim, self.pillar, footprints.max(0))
        for post in self.posts:
            on_side = np.abs(normals[1]) > 0.7
            pane = pane * (1 - on_side * strip(points[0], post - 0.05, post + 0.05, footprints[0]))
        pane = np.where(normals[2] < 0.86, pane, 0).astype(np.float32)
        albedo = mix(column(self.color), column(CAR_GLASS), pane)
        return Appearance(albedo, np.float32(0.35) + np.float32(0.45) * pane)


@dataclass(frozen=True)
class Wheel:
    """Tire and five-spoked rim about the part's z axis, turned by ``angle`` radians."""

    radius: float
    angle: float
    rim: Color

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        x, y, _ = points
        width = footprints[:2].max(0)
        radius = np.hypot(x, y)
        turn = np.cos(5 * (np.arctan2(y, x) + np.float32(self.angle)))
        spoke = beyond(turn * radius, 0.0, width * 3.0)
        inside = 1 - beyond(radius, self.radius * 0.66, width)
        rim = np.maximum(strip(radius, self.radius * 0.56, self.radius * 0.66, width), spoke * inside)
        rim = np.maximum(rim, 1 - beyond(radius, self.radius * 0.18, width)) * (np.abs(normals[2]) > 0.5)
        albedo = mix(column((0.018, 0.018, 0.018)), column(self.rim), rim.astype(np.float32))
        return Appearance(albedo, (np.float32(0.25) * rim).astype(np.float32))


def metallic(rng: np.random.Generator) -> Color:
    """Returns a car color: mostly white, silver, gray, black; sometimes red, blue, green, yellow."""
    palette = (
        (0.62, 0.62, 0.62), (0.40, 0.41, 0.42), (0.17, 0.18, 0.19), (0.03, 0.03, 0.035), (0.36, 0.03, 0.03),
        (0.03, 0.08, 0.30), (0.04, 0.16, 0.10), (0.55, 0.36, 0.05), (0.10, 0.25, 0.42), (0.42, 0.33, 0.24),
    )  # fmt: skip
    weights = np.array([4, 3, 2, 2, 2.5, 2.5, 1.5, 1, 1.5, 1])
    base = np.array(palette[rng.choice(len(palette), p=weights / weights.sum())])
    red, green, blue = base * rng.uniform(0.85, 1.15)
    return (float(red), float(green), float(blue))
