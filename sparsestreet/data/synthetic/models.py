"""Models of the street: cars, people, and what stands beside the road."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from sparsestreet.data.synthetic.shapes import Cylinder, Ellipsoid, box, extrusion
from sparsestreet.data.synthetic.textures import (
    BodyPaint,
    Cabin,
    Color,
    Facade,
    FacadeStyle,
    Grainy,
    Plain,
    Wheel,
    metallic,
)
from sparsestreet.data.synthetic.tracer import Part, Point, at, axis_along_y, limb


@runtime_checkable
class Model(Protocol):
    """An object in its box frame: x along the heading, y left, z up, origin at the box center."""

    @property
    def class_name(self) -> str: ...

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width, height of the box, meters."""
        ...

    def parts(self, traveled: float) -> list[Part]:
        """Return the parts after ``traveled`` meters; wheels turn and legs walk with the distance."""
        ...


@dataclass(frozen=True)
class BodyStyle:
    """Shares of the length from the front bumper, and heights above the road in meters."""

    length: float
    width: float
    height: float
    bonnet: float
    """Start of the windscreen."""
    roof_start: float
    roof_end: float
    tail: float
    """End of the rear window."""
    belt: float
    """Lower edge of the windows."""
    nose: float
    """Height of the bonnet's front edge."""
    posts: tuple[float, ...]


SALOON = BodyStyle(4.6, 1.82, 1.45, 0.26, 0.42, 0.72, 0.86, 0.92, 0.70, (0.53,))
HATCHBACK = BodyStyle(4.0, 1.76, 1.49, 0.24, 0.41, 0.86, 0.96, 0.93, 0.72, (0.58,))
ESTATE = BodyStyle(4.7, 1.84, 1.50, 0.26, 0.42, 0.91, 0.985, 0.94, 0.72, (0.53, 0.74))
TALL = BodyStyle(4.5, 1.88, 1.70, 0.24, 0.38, 0.90, 0.97, 1.05, 0.85, (0.54, 0.75))
VAN = BodyStyle(5.1, 1.98, 2.10, 0.14, 0.29, 0.965, 0.99, 1.15, 0.90, (0.40, 0.68))
STYLES = (SALOON, HATCHBACK, ESTATE, TALL, VAN)

_CLEARANCE = 0.20
_WHEEL_RADIUS = 0.33
_BODY_INSET = 0.02
"""Meters by which the wheels stand out from the body's sides, still within the box."""


@dataclass(frozen=True)
class Car:
    style: BodyStyle
    color: Color
    rim: Color

    class_name = "Vehicle"

    @property
    def size(self) -> tuple[float, float, float]:
        return (self.style.length, self.style.width, self.style.height)

    def parts(self, traveled: float) -> list[Part]:
        return [self._body(), self._cabin(), *self._wheels(traveled)]

    @property
    def _axles(self) -> tuple[float, float]:
        return (self._x(0.19), self._x(0.80))

    def _x(self, share: float) -> float:
        """Return x in the box frame for a share of the length, measured from the front bumper."""
        return self.style.length * (0.5 - share)

    def _body(self) -> Part:
        style = self.style
        middle = (style.belt + _CLEARANCE) / 2
        front, rear, low, high = self._x(0.0), self._x(1.0), _CLEARANCE - middle, style.belt - middle
        nose, tail = style.nose - middle, (style.belt + style.nose) / 2 - middle
        profile = [
            (rear + 0.10, low), (front - 0.12, low), (front, nose - 0.22), (front - 0.06, nose),
            (self._x(style.bonnet), high), (rear + 0.05, high), (rear, tail - 0.1),
        ]  # fmt: skip
        width = style.width - 2 * _BODY_INSET
        paint = BodyPaint(
            color=self.color,
            half_length=style.length / 2,
            half_width=width / 2,
            sill=low + 0.10,
            light=nose - 0.11,
            axles=self._axles,
            axle_height=_WHEEL_RADIUS - middle,
            arch=_WHEEL_RADIUS + 0.05,
            seams=(self._x(style.bonnet + 0.04), self._x(style.posts[0])),
        )
        return Part(extrusion(profile, width, width - 0.06), paint, at(0.0, 0.0, middle - style.height / 2.0))

    def _cabin(self) -> Part:
        style = self.style
        # Sunk a little into the body, so that no gap shows between the two.
        low = style.belt - 0.04
        middle = (low + style.height) / 2
        bottom, top = low - middle, style.height - middle
        profile = [
            (self._x(style.tail), bottom), (self._x(style.bonnet), bottom), (self._x(style.roof_start), top - 0.03),
            (self._x(style.roof_start + 0.10), top), (self._x(style.roof_end - 0.10), top - 0.005),
            (self._x(style.roof_end), top - 0.05),
        ]  # fmt: skip
        width = style.width - 2 * _BODY_INSET - 0.07
        shape = extrusion(profile, width, width - 0.34 * (style.height - style.belt) / 0.55)
        posts = tuple(self._x(post) for post in style.posts)
        return Part(shape, Cabin(self.color, shape, 0.065, posts), at(0.0, 0.0, middle - style.height / 2.0))

    def _wheels(self, traveled: float) -> list[Part]:
        half_width, angle = 0.11, traveled / _WHEEL_RADIUS
        tyre = Cylinder(_WHEEL_RADIUS, half_width)
        y, z = self.style.width / 2 - half_width - 0.004, _WHEEL_RADIUS - self.style.height / 2
        return [
            Part(tyre, Wheel(_WHEEL_RADIUS, angle, self.rim), axis_along_y(x, side * y, z))
            for x in self._axles
            for side in (-1, 1)
        ]


def random_car(rng: np.random.Generator) -> Car:
    style = STYLES[rng.choice(len(STYLES), p=[0.27, 0.27, 0.18, 0.18, 0.10])]
    gray = float(rng.uniform(0.18, 0.42))
    return Car(style, metallic(rng), (gray, gray, gray))


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
        """Return hip, knee and foot of the left (1) or right (-1) leg after ``traveled`` meters."""
        h, scale = self.height, self.height / 1.75
        ground, y = -h / 2, side * 0.085 * scale
        swing, lift = self._swing(side, traveled)
        raised = max(lift, 0.0) * 0.05 * h
        foot = (swing * 0.17 * h - 0.03, y, ground + 0.058 * scale + raised)
        knee = (swing * 0.10 * h + 0.03 + raised * 0.6, y, ground + 0.27 * h + raised * 0.5)
        return (0.0, y, ground + 0.50 * h), knee, foot

    def arm(self, side: int, traveled: float) -> tuple[Point, Point, Point]:
        """Return shoulder, elbow and hand of an arm, which swings against its leg."""
        h, scale = self.height, self.height / 1.75
        shoulder, y = -h / 2 + 0.80 * h, side * 0.19 * scale
        swing = -self._swing(side, traveled)[0]
        elbow = (swing * 0.08 * h - 0.02, y * 1.12, shoulder - 0.17 * h)
        hand = (swing * 0.17 * h + 0.03, y * 1.08, shoulder - 0.32 * h)
        return (0.0, y, shoulder - 0.03 * h), elbow, hand

    def _swing(self, side: int, traveled: float) -> tuple[float, float]:
        """Return how far a leg is ahead and how high it is lifted, both from -1 to 1."""
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


def tree(rng: np.random.Generator) -> list[Part]:
    """Return a trunk with a crown of overlapping balls; origin at the foot."""
    height, reach = float(rng.uniform(5.0, 7.5)), float(rng.uniform(1.1, 1.6))
    stem = height - 1.6 * reach
    bark = Grainy((0.16, 0.11, 0.07), 0.12, 0.25, float(rng.uniform(0.0, 20.0)))
    parts = [Part(Cylinder(float(rng.uniform(0.11, 0.17)), stem / 2.0), bark, at(0.0, 0.0, stem / 2.0))]
    green = np.array([0.13, 0.24, 0.055]) * rng.uniform(0.75, 1.35) + rng.uniform(-0.015, 0.05) * np.array([1, 0.3, 0])
    for index in range(9):
        # The first ball is the core of the crown; the others sit around it.
        turn, tilt = 2.4 * index + rng.uniform(-0.4, 0.4), rng.uniform(-0.55, 0.9)
        away = 0.0 if index == 0 else 0.62 * reach
        x, y = away * np.cos(turn) * np.cos(tilt), away * np.sin(turn) * np.cos(tilt)
        z = height - reach + away * np.sin(tilt) * 1.3
        size = reach * (0.8 if index == 0 else rng.uniform(0.45, 0.62))
        shade = green * rng.uniform(0.88, 1.12)
        leaves = Grainy((float(shade[0]), float(shade[1]), float(shade[2])), 0.34, 0.32, float(rng.uniform(0.0, 20.0)))
        ball = Ellipsoid(np.array([size, size, size * rng.uniform(0.8, 1.0)], np.float32))
        parts.append(Part(ball, leaves, at(float(x), float(y), float(z), float(turn))))
    return parts


def lamp_post(towards: int) -> list[Part]:
    """Return a post with an arm over the road; origin at the foot, ``towards`` is +1 if the road lies at +y."""
    steel, head = Plain((0.13, 0.14, 0.15), 0.15), Plain((0.55, 0.55, 0.52))
    return [
        Part(Cylinder(0.10, 0.4), steel, at(0.0, 0.0, 0.4)),
        Part(Cylinder(0.06, 3.3), steel, at(0.0, 0.0, 3.3)),
        limb((0.0, 0.0, 6.55), (0.0, towards * 1.3, 6.85), 0.045, steel),
        Part(box(0.22, 0.7, 0.12), head, at(0.0, towards * 1.55, 6.86)),
    ]


def bin_box(rng: np.random.Generator) -> list[Part]:
    """Return a litter bin; origin at the foot."""
    color = ((0.05, 0.16, 0.08), (0.40, 0.10, 0.03), (0.10, 0.12, 0.16))[rng.integers(3)]
    return [
        Part(box(0.45, 0.45, 0.9), Grainy(color, 0.3, 0.05), at(0.0, 0.0, 0.45)),
        Part(box(0.52, 0.52, 0.1), Plain((0.05, 0.05, 0.05)), at(0.0, 0.0, 0.95)),
    ]


def house(rng: np.random.Generator, width: float, depth: float, road_side: int) -> list[Part]:
    """Return a house with its front on the plane y = 0 and its body away from the road; centered in x.

    ``road_side`` is +1 if the road lies at +y.
    """
    walls = (
        (0.52, 0.42, 0.30), (0.46, 0.19, 0.13), (0.58, 0.53, 0.45), (0.40, 0.42, 0.45),
        (0.55, 0.36, 0.25), (0.62, 0.55, 0.38), (0.33, 0.15, 0.11), (0.36, 0.44, 0.42),
    )  # fmt: skip
    shops = ((0.35, 0.04, 0.04), (0.04, 0.10, 0.28), (0.03, 0.20, 0.12), (0.09, 0.06, 0.05), (0.45, 0.27, 0.04))
    wall = np.array(walls[rng.integers(len(walls))]) * rng.uniform(0.85, 1.12)
    light = float(rng.uniform(0.45, 0.68))
    storey = float(rng.uniform(2.9, 3.5))
    ground_floor = 3.7
    height = ground_floor + storey * int(rng.integers(2, 5)) + 0.7
    style = FacadeStyle(
        wall=(float(wall[0]), float(wall[1]), float(wall[2])),
        frame=(light, light, light) if rng.random() < 0.75 else (0.10, 0.07, 0.05),
        trim=(light, light * 0.97, light * 0.9),
        shop=shops[rng.integers(len(shops))],
        storey=storey,
        pitch=float(rng.uniform(2.0, 3.0)),
        window_width=float(rng.uniform(0.42, 0.62)),
        window_low=float(rng.uniform(0.24, 0.32)),
        window_high=float(rng.uniform(0.76, 0.84)),
        courses=float(rng.choice([0.0, 0.0, 0.25, 0.4])),
        has_shops=bool(rng.random() < 0.6),
        seed=int(rng.integers(2**31)),
        ground_floor=ground_floor,
    )
    body = box(width, depth, height)
    front = -road_side * depth / 2
    facade = Facade((width / 2, depth / 2, height / 2), style)
    parts = [Part(body, facade, at(0.0, front, height / 2.0))]
    parts.append(Part(box(width + 0.02, depth + 0.5, 0.3), Plain(style.trim), at(0.0, front, height - 0.45)))
    if rng.random() < 0.55:
        parts += _balconies(rng, style, width, height, road_side)
    return parts


def _balconies(rng: np.random.Generator, style: FacadeStyle, width: float, height: float, road_side: int) -> list[Part]:
    cells = max(round((width - 0.6) / style.pitch), 1)
    slab, rail = Plain(style.trim), Plain((0.12, 0.12, 0.13))
    parts = []
    for cell in sorted(rng.choice(cells, size=min(2, cells), replace=False)):
        x, z = (cell + 0.5) * width / cells - width / 2, style.ground_floor + 0.1
        while z + style.storey < height:
            parts.append(Part(box(0.85 * width / cells, 0.9, 0.14), slab, at(x, road_side * 0.45, z)))
            parts.append(Part(box(0.85 * width / cells, 0.06, 0.9), rail, at(x, road_side * 0.87, z + 0.5)))
            z += style.storey
    return parts
