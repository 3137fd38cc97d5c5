"""A tunnel in the place of houses, trees and sky."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic import layout
from sparsestreet.data.synthetic.noise import stream
from sparsestreet.data.synthetic.parts import Part, at
from sparsestreet.data.synthetic.shapes import box
from sparsestreet.data.synthetic.sky import Weather, random_weather
from sparsestreet.data.synthetic.textures.appearance import Color, Vectors, column, mix
from sparsestreet.data.synthetic.textures.plain import Grainy, Plain

_HEIGHT = 6.5
"""Meters from the road to the ceiling."""
_THICKNESS = 2.0
_LAMP: Color = (2.2, 2.1, 1.8)
"""A lamp shines: its color is above what a surface reflects."""
_LIGHT_ABOVE, _LIGHT_BELOW = (0.80, 0.74, 0.62), (0.42, 0.39, 0.34)


@dataclass(frozen=True)
class TunnelLight(Weather):
    """Light of lamps: from above and from the pale road, the same everywhere; the ceiling shades all from the sun."""

    def radiance(self, directions: Vectors) -> Vectors:
        """Returns what is mirrored: the ceiling, brighter straight above."""
        return mix(column(_LIGHT_BELOW), column(_LIGHT_ABOVE), np.maximum(directions[2], np.float32(0)))

    def ambient(self, normals: Vectors) -> Vectors:
        return mix(column(_LIGHT_BELOW), column(_LIGHT_ABOVE), np.float32(0.5) + np.float32(0.5) * normals[2])


def tunnel_light(seed: int) -> TunnelLight:
    """Returns the light of a tunnel under the weather of a seed."""
    return TunnelLight(**vars(random_weather(seed)))


def tunnel(seed: int, end: float) -> list[Part]:
    """Returns walls on both sides, a ceiling and two ends around a drive of ``end`` meters, closed on all sides."""
    rng = stream(seed, "tunnel")
    start, stop = -layout.BEHIND, end + layout.AHEAD
    right, left = layout.CURB_RIGHT - layout.FOOTWAY_WIDTH, layout.CURB_LEFT + layout.FOOTWAY_WIDTH
    length, width = stop - start, left - right
    middle, center = (start + stop) / 2, (left + right) / 2
    long, wide, thick = length + 2 * _THICKNESS, width + 2 * _THICKNESS, _THICKNESS
    concrete = Grainy((0.42, 0.40, 0.37), 1.3, 0.16, float(rng.uniform(0.0, 20.0)))
    side, face = box(long, thick, _HEIGHT + thick), box(thick, wide, _HEIGHT + thick)
    half, up = thick / 2, (_HEIGHT + thick) / 2
    parts = [Part(box(long, wide, thick), concrete, at(middle, center, _HEIGHT + half))]
    parts += [Part(side, concrete, at(middle, y, up)) for y in (right - half, left + half)]
    parts += [Part(face, concrete, at(x, center, up)) for x in (start - half, stop + half)]
    return parts + _fittings(rng, start, stop, right, left)


def _fittings(rng: np.random.Generator, start: float, stop: float, right: float, left: float) -> list[Part]:
    """Returns lamps, tiles, pillars, doors and signs: what tells one place of a tunnel from another."""
    tiles = ((0.62, 0.60, 0.52), (0.50, 0.55, 0.58), (0.55, 0.44, 0.30), (0.30, 0.38, 0.42))
    doors = ((0.05, 0.32, 0.12), (0.45, 0.08, 0.05), (0.08, 0.16, 0.40))
    parts, pitch = [], 5.0
    for x in np.arange(start + pitch / 2, stop, pitch).tolist():
        parts += [Part(box(1.4, 0.35, 0.12), Plain(_LAMP), at(x, y, _HEIGHT - 0.06)) for y in (0.0, 7.0)]
        for wall, inwards in ((right, 1), (left, -1)):
            tile = np.array(tiles[rng.integers(len(tiles))]) * rng.uniform(0.85, 1.1)
            surface = Grainy(tuple(tile.tolist()), 0.5, 0.12, float(rng.uniform(0.0, 20.0)))
            parts.append(Part(box(pitch - 0.3, 0.1, 2.6), surface, at(x, wall + 0.02 * inwards, 1.7)))
            pillar = Grainy((0.30, 0.29, 0.28), 0.4, 0.15, float(rng.uniform(0.0, 20.0)))
            parts.append(Part(box(0.5, 0.5, _HEIGHT), pillar, at(x + pitch / 2, wall, _HEIGHT / 2)))
            if rng.random() < 0.4:
                place = x + float(rng.uniform(-1, 1))
                door = Plain(doors[rng.integers(len(doors))], 0.1)
                parts.append(Part(box(1.1, 0.12, 2.1), door, at(place, wall + 0.06 * inwards, 1.2)))
                sign = Plain((0.05, 0.45, 0.18) if rng.random() < 0.5 else (0.6, 0.6, 0.55))
                parts.append(Part(box(0.9, 0.08, 0.45), sign, at(place, wall + 0.1 * inwards, 3.6)))
    return parts
