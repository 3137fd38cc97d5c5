"""Saloons, hatchbacks, estates and vans: a lower body, a cabin and four wheels, inside the annotated box."""

from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.parts import Part, at, axis_along_y
from sparsestreet.data.synthetic.shapes import Cylinder, extrusion
from sparsestreet.data.synthetic.textures.appearance import Color
from sparsestreet.data.synthetic.textures.car import BodyPaint, Cabin, Wheel, metallic


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
        """Returns x in the box frame for a share of the length, measured from the front bumper."""
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
