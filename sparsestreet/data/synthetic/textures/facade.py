"""Walls with storeys of windows, and a ground floor with doors and shop windows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from sparsestreet.data.synthetic.coverage import beyond, strip, stripes
from sparsestreet.data.synthetic.noise import cell_random, smooth_noise
from sparsestreet.data.synthetic.textures.appearance import Appearance, Color, Scalars, Vectors, column, mix

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
        """Returns the wall with ledges between storeys, sills under windows and the cornice."""
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
        """Returns frame color, frame coverage and glass color; and the coverage of the glass."""
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
        """Returns the color of the ground floor and the coverage of its glass."""
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
