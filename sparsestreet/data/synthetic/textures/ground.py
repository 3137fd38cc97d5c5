"""Asphalt with lane markings, and paved footways with curbs. Points are in the world frame except for a shift in z."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.coverage import beyond, strip, stripes
from sparsestreet.data.synthetic.noise import cell_random, smooth_noise
from sparsestreet.data.synthetic.textures.appearance import Appearance, Color, Scalars, Vectors, column, mix

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
