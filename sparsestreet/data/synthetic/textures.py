"""Textures of the street: value noise, coverage of stripes, and the colors of cars, facades, ground and sky."""

import functools
import zlib
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from sparsestreet.data.synthetic.shapes import Polytope, Scalars, Vectors

Color = tuple[float, float, float]
"""Linear RGB reflectance in [0, 1]."""


@dataclass(frozen=True)
class Appearance:
    """Appearance of surface points."""

    albedo: Vectors
    """Linear RGB reflectance."""
    gloss: Scalars
    """Weight of the mirrored sky in [0, 1]; 0 is matt."""


@runtime_checkable
class Surface(Protocol):
    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        """Return the appearance at points of the part's frame; ``footprints`` are a pixel's extents in it, meters."""
        ...


def column(color: Color) -> Float32[np.ndarray, "3 1"]:
    return np.array(color, np.float32)[:, None]


def mix(below: Float32[np.ndarray, "3 _"], above: Float32[np.ndarray, "3 _"], share: Scalars) -> Vectors:
    """Return ``below`` with ``above`` painted over it where ``share`` is 1.

    >>> mix(column((0.0, 0.0, 0.0)), column((1.0, 1.0, 1.0)), np.float32([0.25]))[0].tolist()
    [0.25]
    """
    return below + (above - below) * share


def strip(x: Scalars, low: float, high: float, footprint: Scalars) -> Scalars:
    """Return the share of the interval of length ``footprint`` around x that lies in [low, high].

    >>> strip(np.float32([0.0]), 0.0, 1.0, np.float32([1.0])).tolist()
    [0.5]
    """
    half = footprint * np.float32(0.5)
    overlap = np.minimum(x + half, np.float32(high)) - np.maximum(x - half, np.float32(low))
    return np.clip(overlap / np.maximum(footprint, np.float32(1e-6)), 0, 1)


def beyond(x: Scalars, edge: float, footprint: Scalars) -> Scalars:
    """Return the share of the interval of length ``footprint`` around x that lies above ``edge``.

    >>> beyond(np.float32([0.25]), 0.0, np.float32([1.0])).tolist()
    [0.75]
    """
    return np.clip((x - np.float32(edge)) / np.maximum(footprint, np.float32(1e-6)) + np.float32(0.5), 0, 1)


def stripes(x: Scalars, period: float, low: float, high: float, footprint: Scalars) -> Scalars:
    """Return the share of the interval of length ``footprint`` around x in the strips [low, high] + k period.

    0 <= low < high <= period.

    >>> stripes(np.float32([5.0]), 2.0, 0.0, 1.0, np.float32([4.0])).tolist()
    [0.5]
    """
    width = np.maximum(footprint, np.float32(1e-6))
    half = width * np.float32(0.5)
    return (_painted(x + half, period, low, high) - _painted(x - half, period, low, high)) / width


def _painted(x: Scalars, period: float, low: float, high: float) -> Scalars:
    """Return the length of the strips between 0 and x."""
    whole = np.floor(x * np.float32(1 / period))
    rest = x - whole * np.float32(period)
    return whole * np.float32(high - low) + np.clip(rest - np.float32(low), 0, np.float32(high - low))


_CELLS = 32
_TEXELS_PER_CELL = 32
_SIZE = _CELLS * _TEXELS_PER_CELL


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one element of the street; adding an element does not change the others.

    >>> stream(0, "houses").random() == stream(0, "houses").random()
    True
    """
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


@functools.cache
def _table() -> Float32[np.ndarray, " m"]:
    """Return one tile of periodic value noise, mean 0 and standard deviation 1, fine enough to read unfiltered."""
    lattice = np.random.default_rng(20240229).standard_normal((_CELLS, _CELLS))
    rows = _interpolated(lattice)
    tile = _interpolated(np.ascontiguousarray(rows.T)).T
    return ((tile - tile.mean()) / tile.std()).astype(np.float32).ravel()


def _interpolated(values: Float64[np.ndarray, "a b"]) -> Float64[np.ndarray, "c b"]:
    """Interpolates rows periodically by the quintic fade of Perlin (2002), whose second derivative is continuous."""
    t = np.arange(_TEXELS_PER_CELL)[None, :, None] / _TEXELS_PER_CELL
    fade = t**3 * (t * (6 * t - 15) + 10)
    following = np.roll(values, -1, axis=0)
    return (values[:, None] * (1 - fade) + following[:, None] * fade).reshape(_SIZE, -1)


def smooth_noise(
    u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"], cell: float, footprint: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, " n"]:
    """Return noise with features of ``cell`` meters, faded out if a pixel's ``footprint`` (meters) is half a cell."""
    scale = np.float32(_TEXELS_PER_CELL / cell)
    column = np.floor(u * scale).astype(np.int32) & (_SIZE - 1)
    row = np.floor(v * scale).astype(np.int32) & (_SIZE - 1)
    fade = np.clip(np.float32(1.5) - footprint * np.float32(2 / cell), 0, 1)
    return _table()[row * _SIZE + column] * fade


def cell_random(
    column: Float32[np.ndarray, " n"], row: Float32[np.ndarray, " n"], seed: int
) -> Float32[np.ndarray, " n"]:
    """Return a number in [0, 1) that depends only on the integer cell and the seed (a multiply-xorshift hash)."""
    with np.errstate(over="ignore"):
        h = column.astype(np.int32).view(np.uint32) * np.uint32(0x9E3779B1)
        h ^= row.astype(np.int32).view(np.uint32) * np.uint32(0x85EBCA77)
        h += np.uint32(seed & 0xFFFFFFFF)
        h ^= h >> np.uint32(15)
        h *= np.uint32(0x2C1B3C6D)
        h ^= h >> np.uint32(12)
        h *= np.uint32(0x297A2D39)
        h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


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
    """Return a car color: mostly white, silver, gray, black; sometimes red, blue, green, yellow."""
    palette = (
        (0.62, 0.62, 0.62), (0.40, 0.41, 0.42), (0.17, 0.18, 0.19), (0.03, 0.03, 0.035), (0.36, 0.03, 0.03),
        (0.03, 0.08, 0.30), (0.04, 0.16, 0.10), (0.55, 0.36, 0.05), (0.10, 0.25, 0.42), (0.42, 0.33, 0.24),
    )  # fmt: skip
    weights = np.array([4, 3, 2, 2, 2.5, 2.5, 1.5, 1, 1.5, 1])
    base = np.array(palette[rng.choice(len(palette), p=weights / weights.sum())])
    red, green, blue = base * rng.uniform(0.85, 1.15)
    return (float(red), float(green), float(blue))


GLASS = (0.035, 0.045, 0.06)
ROOF = (0.16, 0.14, 0.13)


@dataclass(frozen=True)
class FacadeStyle:
    """The look of one house; lengths in meters, shares of a window's cell in [0, 1]."""

    wall: Color
    frame: Color
    trim: Color
    """Ledges, sills, cornice."""
    shop: Color
    """Sign board and doors."""
    storey: float
    pitch: float
    """Wanted distance between window centers; the face's width is divided evenly."""
    window_width: float
    window_low: float
    window_high: float
    courses: float
    """Height of the visible brick or stone courses; 0: plaster."""
    has_shops: bool
    seed: int
    ground_floor: float = 3.7


@dataclass(frozen=True)
class _Face:
    """Coordinates on the face of each point: u along it, z up from the ground, and the footprints there."""

    u: Scalars
    z: Scalars
    fu: Scalars
    fz: Scalars
    cells: Scalars
    """Number of windows side by side."""
    width: Scalars
    seed: Float32[np.ndarray, " n"]
    """Different on the four faces."""


@dataclass(frozen=True)
class Facade:
    half_extent: tuple[float, float, float]
    style: FacadeStyle

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        face = self._face(points, normals, footprints)
        albedo = self._wall(face)
        s, fs = face.u / face.width * face.cells, face.fu / face.width * face.cells
        column_index = np.floor(s) + face.seed * 64
        upper, glass_upper = self._windows(face, s, fs, column_index)
        lower, glass_lower = self._ground_floor(face, s, fs, column_index, albedo)
        albedo = self._upper(face, albedo, s, fs)
        above = beyond(face.z, self.style.ground_floor, face.fz)
        albedo = mix(mix(albedo, upper[0], upper[1]), upper[2], glass_upper)
        albedo = mix(lower, albedo, above)
        glass = glass_upper * above + glass_lower * (1 - above)
        roof = normals[2] > 0.5
        albedo = np.where(roof, column(ROOF), albedo)
        return Appearance(albedo, np.where(roof, 0, glass).astype(np.float32) * np.float32(0.8))

    def _face(self, points: Vectors, normals: Vectors, footprints: Vectors) -> _Face:
        hx, hy, hz = (np.float32(h) for h in self.half_extent)
        across = np.abs(normals[0]) > 0.5
        width = np.where(across, 2 * hy, 2 * hx).astype(np.float32)
        return _Face(
            u=np.where(across, points[1] + hy, points[0] + hx),
            z=points[2] + hz,
            fu=np.where(across, footprints[1], footprints[0]),
            fz=footprints[2],
            cells=np.maximum(np.round((width - np.float32(0.6)) / np.float32(self.style.pitch)), 1),
            width=width,
            seed=(across + 2 * ((normals[0] + normals[1]) > 0)).astype(np.float32),
        )

    def _wall(self, face: _Face) -> Vectors:
        style = self.style
        size = np.maximum(face.fu, face.fz)
        tone = 1 + np.float32(0.05) * smooth_noise(face.u + style.seed % 31, face.z, 1.3, size)
        # Rain streaks: long in z, short in u.
        tone += np.float32(0.04) * smooth_noise(face.u * 3, face.z * np.float32(0.4), 0.9, face.fu * 3)
        wall = column(style.wall) * tone
        if style.courses > 0:
            bed = stripes(face.z, style.courses, 0.0, style.courses * 0.14, face.fz)
            odd = np.floor(face.z / np.float32(style.courses)) % 2
            shifted = face.u + odd * np.float32(style.courses)
            head = stripes(shifted, 2 * style.courses, 0.0, style.courses * 0.14, face.fu)
            wall = mix(wall, wall * np.float32(0.68), np.maximum(bed, head))
        # Damp and dirt near the ground.
        return wall * (np.float32(0.78) + np.float32(0.22) * np.clip(face.z / np.float32(0.7), 0, 1))

    def _upper(self, face: _Face, albedo: Vectors, s: Scalars, fs: Scalars) -> Vectors:
        """Return the wall with ledges between storeys, sills under windows and the cornice."""
        style = self.style
        z, fz = face.z - np.float32(style.ground_floor), face.fz
        low = style.window_low * style.storey
        ledge = stripes(z, style.storey, 0.0, 0.16, fz)
        sill = stripes(z, style.storey, low - 0.16, low - 0.04, fz)
        sill *= stripes(s, 1.0, 0.46 - style.window_width / 2, 0.54 + style.window_width / 2, fs)
        cornice = beyond(face.z, 2 * self.half_extent[2] - 0.55, fz)
        return mix(albedo, column(style.trim), np.maximum(np.maximum(ledge, sill), cornice))

    def _windows(
        self, face: _Face, s: Scalars, fs: Scalars, column_index: Scalars
    ) -> tuple[tuple[Float32[np.ndarray, "3 1"], Scalars, Vectors], Scalars]:
        """Return frame color, frame coverage and glass color; and the coverage of the glass."""
        style = self.style
        z = (face.z - np.float32(style.ground_floor)) / np.float32(style.storey)
        fz = face.fz / np.float32(style.storey)
        half = style.window_width / 2
        below_roof = 1 - beyond(face.z, 2 * self.half_extent[2] - 0.7, face.fz)
        opening = stripes(s, 1.0, 0.5 - half, 0.5 + half, fs) * below_roof
        opening = opening * stripes(z, 1.0, style.window_low, style.window_high, fz)
        rim_s, rim_z = 0.07 / style.pitch, 0.07 / style.storey
        panes = stripes(s, 1.0, 0.5 - half + rim_s, 0.5 - rim_s / 2, fs)
        panes = panes + stripes(s, 1.0, 0.5 + rim_s / 2, 0.5 + half - rim_s, fs)
        glass = panes * stripes(z, 1.0, style.window_low + rim_z, style.window_high - rim_z, fz) * below_roof
        detail = np.clip(np.float32(1.5) - 2 * np.maximum(fs, fz), 0, 1)
        kind = cell_random(column_index, np.floor(z), style.seed)
        # One window in three shows a light curtain or blind, drawn to a random height.
        drawn = np.float32(1.0) - z % 1 < (kind * 3 % 1) * np.float32(style.window_high)
        curtain = np.where(kind > 0.6, np.where(drawn, np.float32(0.9), np.float32(0.25)), 0) * detail
        pane = mix(column(GLASS), column((0.42, 0.39, 0.34)), (curtain * np.float32(0.6)).astype(np.float32))
        return (column(style.frame), opening, pane), glass

    def _ground_floor(
        self, face: _Face, s: Scalars, fs: Scalars, column_index: Scalars, wall: Vectors
    ) -> tuple[Vectors, Scalars]:
        """Return the color of the ground floor and the coverage of its glass."""
        style = self.style
        z, fz = face.z, face.fz
        kind = cell_random(column_index, np.full_like(s, -7), style.seed)
        door = (kind < 0.3) * stripes(s, 1.0, 0.28, 0.72, fs) * strip(z, 0.0, 2.45, fz)
        door_pane = (kind < 0.3) * stripes(s, 1.0, 0.36, 0.64, fs) * strip(z, 1.2, 2.25, fz)
        low, margin = (0.45, 0.08) if style.has_shops else (1.1, 0.26)
        pane = (kind >= 0.3) * stripes(s, 1.0, margin, 1 - margin, fs) * strip(z, low, 2.6, fz)
        frame = (kind >= 0.3) * stripes(s, 1.0, margin - 0.04, 1.04 - margin, fs) * strip(z, low - 0.12, 2.72, fz)
        albedo = mix(wall, column(style.frame), frame.astype(np.float32))
        albedo = mix(albedo, column(style.shop), door.astype(np.float32))
        if style.has_shops:
            albedo = mix(albedo, column(style.shop), strip(z, 2.85, 3.4, fz))
            # Blocks stand for the letters of the sign.
            letters = stripes(face.u, 0.55, 0.1, 0.42, face.fu) * strip(z, 2.98, 3.27, fz)
            written = cell_random(np.floor(face.u / np.float32(0.55)), face.seed, style.seed) < 0.55
            albedo = mix(albedo, column((0.8, 0.78, 0.7)), (letters * written * np.float32(0.8)).astype(np.float32))
        glass = np.maximum(pane, door_pane).astype(np.float32)
        return mix(albedo, column((0.06, 0.06, 0.065)), glass), glass


WHITE = (0.72, 0.72, 0.70)


@dataclass(frozen=True)
class Lines:
    """Positions of paint on the road, meters; x is along the road."""

    solid: tuple[float, ...]
    dashed: tuple[float, ...]
    crossings: tuple[float, ...]
    """Near ends (x) of the zebra crossings."""
    curb_right: float
    curb_left: float

    width: float = 0.14
    dash: float = 3.0
    dash_period: float = 9.0
    crossing_length: float = 3.2


@dataclass(frozen=True)
class Asphalt:
    lines: Lines
    color: Color
    offset: float
    grass: Color = (0.10, 0.16, 0.05)

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        x, y, _ = points
        fx, fy, _ = footprints
        road = column(self.color) * self._tone(x, y, np.maximum(fx, fy))
        albedo = mix(road, column(WHITE), self._paint(x, y, fx, fy) * np.float32(0.9))
        on_road = strip(y, self.lines.curb_right - 0.5, self.lines.curb_left + 0.5, fy)
        albedo = mix(column(self.grass), albedo, on_road)
        return Appearance(albedo, np.zeros(len(x), np.float32))

    def _tone(self, x: Scalars, y: Scalars, width: Scalars) -> Scalars:
        shift = np.float32(self.offset)
        tone = 1 + np.float32(0.07) * smooth_noise(x + shift, y, 1.7, width)
        tone += np.float32(0.08) * smooth_noise(x - y, x + y + shift, 0.12, width)
        # Repaired strips of darker asphalt, 6 m long, in one of five places.
        patch = cell_random(np.floor(x / 6), np.floor((y + 0.3) / 1.7), int(self.offset * 100)) < 0.12
        return tone - np.float32(0.13) * patch

    def _paint(self, x: Scalars, y: Scalars, fx: Scalars, fy: Scalars) -> Scalars:
        lines, half = self.lines, self.lines.width / 2
        paint = np.zeros_like(x)
        for at in lines.solid:
            paint += strip(y, at - half, at + half, fy)
        dashes = stripes(x, lines.dash_period, 0.0, lines.dash, fx)
        for at in lines.dashed:
            paint += strip(y, at - half, at + half, fy) * dashes
        bars = stripes(y, 1.0, 0.25, 0.75, fy) * strip(y, lines.curb_right + 0.4, lines.curb_left - 0.4, fy)
        for start in lines.crossings:
            zone = strip(x, start, start + lines.crossing_length, fx)
            paint = paint * (1 - zone) + bars * zone
        return np.minimum(paint, 1)


@dataclass(frozen=True)
class Footway:
    """Slabs with joints, and a curb stone along the road. ``curb_side`` is +1 if the road lies towards +y."""

    color: Color
    half_width: float
    curb_side: int
    offset: float

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        x, y, _ = points
        fx, fy, _ = footprints
        slab_x, slab_y = np.floor(x / 0.9), np.floor(y / 0.6)
        width = np.maximum(fx, fy)
        visible = np.clip(np.float32(1.5) - width * 2, 0, 1)
        tone = 1 + np.float32(0.16) * (cell_random(slab_x, slab_y, 7) - np.float32(0.5)) * visible
        tone += np.float32(0.06) * smooth_noise(x + np.float32(self.offset), y, 0.8, width)
        joints = np.maximum(stripes(x, 0.9, 0.0, 0.03, fx), stripes(y, 0.6, 0.0, 0.03, fy))
        slabs = mix(column(self.color) * tone, column((0.12, 0.12, 0.12)), joints * np.float32(0.6))
        curb = beyond(y * np.float32(self.curb_side), self.half_width - 0.22, fy)
        gaps = stripes(x, 1.0, 0.0, 0.025, fx) * np.float32(0.5)
        stone = column((0.46, 0.45, 0.43)) * (1 - gaps)
        return Appearance(mix(slabs, stone, curb), np.zeros(len(x), np.float32))


@dataclass(frozen=True)
class Plain:
    """A single color, as of paint, metal, or cloth seen from far."""

    color: Color
    gloss: float = 0.0

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        albedo = np.repeat(column(self.color), points.shape[1], axis=1)
        return Appearance(albedo, np.full(points.shape[1], self.gloss, np.float32))


@dataclass(frozen=True)
class Grainy:
    """A color modulated by noise of two sizes: cloth, bark, foliage, rough walls."""

    color: Color
    coarse: float
    """Size of the large features, meters; the fine ones are a third of it."""
    contrast: float
    """Standard deviation of the relative brightness."""
    offset: float = 0.0
    """Meters by which the pattern is shifted, so that copies differ."""

    def appearance(self, points: Vectors, normals: Vectors, footprints: Vectors) -> Appearance:
        # Each point uses the section of the noise that its surface faces most, so no section is seen edge-on.
        x, y, z = points + np.float32(self.offset)
        facing = np.abs(normals).argmax(0)
        u, v = np.where(facing == 0, y, x), np.where(facing == 2, y, z)
        width = footprints.max(0)
        grain = smooth_noise(u, v, self.coarse, width)
        grain += np.float32(0.6) * smooth_noise(u + v, u - v, self.coarse / 3, width)
        albedo = column(self.color) * np.maximum(1 + np.float32(self.contrast) * grain, np.float32(0.15))
        return Appearance(np.minimum(albedo, np.float32(0.95)), np.zeros(points.shape[1], np.float32))


SUNLIGHT = (2.55, 2.35, 2.0)
SKY_AMBIENT = (0.52, 0.62, 0.80)
GROUND_AMBIENT = (0.34, 0.31, 0.27)


@dataclass(frozen=True)
class Weather:
    """The light of the whole drive, in linear RGB radiance; 1 is about white in the picture."""

    sun: Float32[np.ndarray, "3"]
    """Unit direction towards the sun, world frame."""
    zenith: Color
    horizon: Color
    cloudiness: float
    """Approximate share of the sky that clouds cover."""
    cloud_offset: float

    def radiance(self, directions: Vectors) -> Vectors:
        """Return the sky in unit directions of the world frame; it has the horizon's color below the horizon."""
        up = np.maximum(directions[2], 0)
        sky = mix(column(self.horizon), column(self.zenith), 1 - np.exp(np.float32(-3.2) * up))
        sky = mix(sky, column((0.98, 0.98, 0.99)), self._clouds(directions, up))
        towards = np.maximum((directions * self.sun[:, None]).sum(0), 0)
        glow = np.float32(0.35) * towards**6 + np.float32(0.7) * towards**64 + np.float32(6) * (towards > 0.9993)
        return sky + column((1.0, 0.9, 0.72)) * glow

    def _clouds(self, directions: Vectors, up: Scalars) -> Scalars:
        """Return the opacity of clouds on a plane 1 unit above, faded at the horizon, where it would be noise."""
        reach = np.float32(1) / (up + np.float32(0.22))
        u, v = directions[0] * reach, directions[1] * reach
        shift, none = np.float32(self.cloud_offset), np.zeros_like(u)
        density = smooth_noise(u + shift, v - shift, 0.9, none) + np.float32(0.5) * smooth_noise(
            u, v + shift, 0.33, none
        )
        density += np.float32(0.22) * smooth_noise(u - shift, v, 0.13, none)
        cover = np.clip((density - np.float32(1.3 - 2.2 * self.cloudiness)) * np.float32(0.7), 0, 1)
        return np.float32(0.85) * cover * np.clip(up * 7, 0, 1)

    def ambient(self, normals: Vectors) -> Vectors:
        """Return the light from sky and ground on a surface with these normals."""
        return mix(column(GROUND_AMBIENT), column(SKY_AMBIENT), np.float32(0.5) + np.float32(0.5) * normals[2])


def random_weather(seed: int) -> Weather:
    """Return weather with a sun close enough to the street's direction that houses do not shade all of the road."""
    rng = stream(seed, "weather")
    azimuth = float(rng.uniform(0.12, 0.30)) * np.pi * (1 if rng.random() < 0.5 else -1)
    if rng.random() < 0.6:  # from behind, so that more of the front camera's view is lit
        azimuth = np.pi - azimuth
    elevation = np.radians(float(rng.uniform(38, 56)))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    blue = float(rng.uniform(0.8, 1.1))
    return Weather(
        sun=sun.astype(np.float32),
        zenith=(0.13 * blue, 0.28 * blue, 0.62 * blue),
        horizon=(0.62, 0.72, 0.84),
        cloudiness=float(rng.uniform(0.25, 0.55)),
        cloud_offset=float(rng.uniform(0, 25)),
    )
