"""Walking people and cyclists from capsules and balls."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.parts import Part, Point, at, axis_along_y, limb
from sparsestreet.data.synthetic.shapes import Cylinder, Ellipsoid
from sparsestreet.data.synthetic.textures.appearance import Color
from sparsestreet.data.synthetic.textures.car import Wheel
from sparsestreet.data.synthetic.textures.plain import Grainy, Plain


@dataclass(frozen=True)
class Clothes:
    """Colors of a person."""

    top: Color
    trousers: Color
    skin: Color
    hair: Color


def _head(x: float, z: float, scale: float, clothes: Clothes) -> list[Part]:
    face = Ellipsoid(np.array([0.095, 0.08, 0.125], np.float32) * np.float32(scale))
    hair = Ellipsoid(np.array([0.1, 0.09, 0.1], np.float32) * np.float32(scale))
    back, up = 0.02 * scale, 0.045 * scale
    return [Part(face, Plain(clothes.skin), at(x, 0.0, z)), Part(hair, Plain(clothes.hair), at(x - back, 0.0, z + up))]


def _leg(
    hip: Point, knee: Point, foot: Point,
    scale: float, clothes: Clothes,
) -> list[Part]:  # fmt: skip
    trousers, shoe = Plain(clothes.trousers), Plain((0.04, 0.035, 0.03))
    toe = (foot[0] + 0.13 * scale, foot[1], foot[2] - 0.01 * scale)
    return [
        limb(hip, knee, 0.075 * scale, trousers),
        limb(knee, foot, 0.058 * scale, trousers),
        limb(foot, toe, 0.045 * scale, shoe),
    ]


@dataclass(frozen=True)
class Pedestrian:
    height: float
    clothes: Clothes
    stride: float = 1.4
    """Length of one full gait cycle (two steps), meters."""
    limp: float = 0.0
    """Share by which the right leg and arm swing less than the left ones."""

    class_name = "Pedestrian"

    @property
    def size(self) -> tuple[float, float, float]:
        return (0.56 * self.height, 0.36 * self.height, self.height)

    def parts(self, traveled: float) -> list[Part]:
        h, scale = self.height, self.height / 1.75
        ground = -h / 2
        hip, shoulder = ground + 0.50 * h, ground + 0.80 * h
        cloth, skin = Grainy(self.clothes.top, 0.25, 0.08), Plain(self.clothes.skin)
        torso = limb((0.0, 0.0, hip + 0.02 * h), (0.02, 0.0, shoulder - 0.03 * h), 0.135 * scale, cloth)
        parts = [torso, *_head(0.02, ground + 0.915 * h, scale, self.clothes)]
        for side in (-1, 1):
            parts += _leg(*self.leg(side, traveled), scale, self.clothes)
            start, elbow, hand = self.arm(side, traveled)
            parts += [
                limb(start, elbow, 0.05 * scale, cloth),
                limb(elbow, hand, 0.042 * scale, cloth),
                Part(Ellipsoid(np.full(3, 0.05 * scale, np.float32)), skin, at(*hand)),
            ]
        return parts

    def leg(self, side: int, traveled: float) -> tuple[Point, Point, Point]:
        """Returns hip, knee and foot of the left (1) or right (-1) leg after ``traveled`` meters."""
        h, scale = self.height, self.height / 1.75
        ground, y = -h / 2, side * 0.085 * scale
        swing, lift = self._swing(side, traveled)
        raised = max(lift, 0.0) * 0.05 * h
        foot = (swing * 0.17 * h - 0.03, y, ground + 0.058 * scale + raised)
        knee = (swing * 0.10 * h + 0.03 + raised * 0.6, y, ground + 0.27 * h + raised * 0.5)
        return (0.0, y, ground + 0.50 * h), knee, foot

    def arm(self, side: int, traveled: float) -> tuple[Point, Point, Point]:
        """Returns shoulder, elbow and hand of an arm, which swings against its leg."""
        h, scale = self.height, self.height / 1.75
        shoulder, y = -h / 2 + 0.80 * h, side * 0.19 * scale
        swing = -self._swing(side, traveled)[0]
        elbow = (swing * 0.08 * h - 0.02, y * 1.12, shoulder - 0.17 * h)
        hand = (swing * 0.17 * h + 0.03, y * 1.08, shoulder - 0.32 * h)
        return (0.0, y, shoulder - 0.03 * h), elbow, hand

    def _swing(self, side: int, traveled: float) -> tuple[float, float]:
        """Returns how far a leg is ahead and how high it is lifted, both from -1 to 1."""
        gait, reach = 2 * np.pi * traveled / self.stride, 1.0 if side > 0 else 1 - self.limp
        return float(np.sin(gait)) * side * reach, float(np.cos(gait)) * side * reach


@dataclass(frozen=True)
class Cyclist:
    clothes: Clothes
    frame: Color

    class_name = "Cyclist"
    size = (1.82, 0.62, 1.82)

    def parts(self, traveled: float) -> list[Part]:
        ground, radius = -self.size[2] / 2, 0.34
        axle = ground + radius
        front, rear, crank = (0.54, 0.0, axle), (-0.54, 0.0, axle), (-0.05, 0.0, axle - 0.04)
        seat, bar = (-0.22, 0.0, ground + 0.95), (0.40, 0.0, ground + 1.02)
        metal = Plain(self.frame, 0.3)
        tyre = Cylinder(radius, 0.02)
        wheel = Wheel(radius, traveled / radius, (0.35, 0.35, 0.36))
        parts = [Part(tyre, wheel, axis_along_y(x, 0.0, axle)) for x in (front[0], rear[0])]
        for start, end in ((rear, crank), (crank, seat), (crank, bar), (seat, rear), (bar, front), (seat, bar)):
            parts.append(limb(start, end, 0.022, metal))
        parts.append(limb((bar[0], -0.24, bar[2] + 0.04), (bar[0], 0.24, bar[2] + 0.04), 0.02, metal))
        return parts + self._rider(traveled, seat, bar, crank)

    def _rider(self, traveled: float, seat: Point, bar: Point, crank: Point) -> list[Part]:
        cloth = Grainy(self.clothes.top, 0.25, 0.08)
        hip, shoulder = (seat[0], 0.0, seat[2] + 0.10), (0.08, 0.0, seat[2] + 0.50)
        parts = [limb(hip, shoulder, 0.14, cloth), *_head(0.17, shoulder[2] + 0.20, 1.0, self.clothes)]
        for side in (-1, 1):
            angle = traveled / 0.9 + (np.pi if side > 0 else 0.0)
            foot = (crank[0] + 0.15 * float(np.cos(angle)), side * 0.11, crank[2] - 0.15 * float(np.sin(angle)) + 0.03)
            knee = ((foot[0] + hip[0]) / 2 + 0.22, side * 0.12, (foot[2] + hip[2]) / 2 + 0.08)
            parts += _leg((hip[0], side * 0.09, hip[2]), knee, foot, 1.0, self.clothes)
            hand, elbow = (bar[0], side * 0.21, bar[2] + 0.07), (0.22, side * 0.24, shoulder[2] - 0.24)
            parts.append(limb((shoulder[0], side * 0.19, shoulder[2]), elbow, 0.05, cloth))
            parts.append(limb(elbow, hand, 0.042, cloth))
        return parts


def random_clothes(rng: np.random.Generator) -> Clothes:
    tops = (
        (0.45, 0.05, 0.05), (0.05, 0.12, 0.42), (0.55, 0.42, 0.05), (0.05, 0.28, 0.12),
        (0.55, 0.55, 0.52), (0.30, 0.08, 0.30), (0.60, 0.22, 0.05), (0.05, 0.30, 0.36),
    )  # fmt: skip
    trousers = ((0.05, 0.07, 0.16), (0.04, 0.04, 0.045), (0.26, 0.21, 0.14), (0.16, 0.17, 0.18))
    skins = ((0.55, 0.36, 0.27), (0.40, 0.24, 0.16), (0.20, 0.11, 0.07))
    hairs = ((0.03, 0.02, 0.015), (0.12, 0.07, 0.03), (0.32, 0.22, 0.10), (0.30, 0.30, 0.30))
    chosen = [palette[rng.integers(len(palette))] for palette in (tops, trousers, skins, hairs)]
    return Clothes(*chosen)


def random_pedestrian(rng: np.random.Generator, limp: float = 0.0) -> Pedestrian:
    return Pedestrian(float(rng.uniform(1.58, 1.90)), random_clothes(rng), limp=limp)


def random_cyclist(rng: np.random.Generator) -> Cyclist:
    frames = ((0.45, 0.04, 0.04), (0.04, 0.10, 0.40), (0.04, 0.04, 0.04), (0.50, 0.50, 0.50))
    return Cyclist(random_clothes(rng), frames[rng.integers(len(frames))])
