"""Positions of things over time: straight along the street, with one smooth change of lane, or straight across it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import TURNS, swing


class Way(ABC):
    """Where a thing is over time."""

    @abstractmethod
    def traveled(self, time: float) -> float:
        """Returns meters that its wheels or legs have moved since time 0."""

    @abstractmethod
    def pose(self, time: float, height: float) -> Pose:
        """Returns world from object, with the object's origin ``height`` meters above the road."""


@dataclass(frozen=True)
class Path(Way):
    """x = start + speed t; y moves by ``shift`` around ``shift_time`` (world frame, meters and seconds).

    >>> Path(start=5.0, y=1.0, speed=2.0).position(3.0)
    (11.0, 1.0)
    """

    start: float
    y: float
    speed: float
    """Signed speed along x, meters per second; a thing with speed 0 has the heading ``rest_heading``."""
    shift: float = 0.0
    shift_time: float = 0.0
    shift_duration: float = 2.5
    rest_heading: float = 0.0

    def position(self, time: float) -> tuple[float, float]:
        return self.start + self.speed * time, self.y + self.shift * self._eased(time)

    def heading(self, time: float) -> float:
        """Returns the angle of the path's tangent from +x, radians."""
        if self.speed == 0:
            return self.rest_heading
        s = self._phase(time)
        sideways = self.shift * 6 * s * (1 - s) / self.shift_duration
        return float(np.arctan2(sideways, self.speed))

    def traveled(self, time: float) -> float:
        """Returns meters along x since time 0; the sideways part would turn wheels by less than a percent."""
        return abs(self.speed) * time

    def pose(self, time: float, height: float) -> Pose:
        """Returns world from object, with the object's origin ``height`` meters above the road."""
        x, y = self.position(time)
        return at(x, y, height, self.heading(time))

    def _phase(self, time: float) -> float:
        return float(np.clip((time - self.shift_time) / self.shift_duration + 0.5, 0, 1))

    def _eased(self, time: float) -> float:
        s = self._phase(time)
        return s * s * (3 - 2 * s)


@dataclass(frozen=True)
class Crossing(Way):
    """Waits at one side of the lanes, walks straight across and stands at the other (world frame, meters and seconds).

    >>> Crossing(x=5.0, start=-3.0, end=8.0, speed=2.0, at=1.0).position(2.0)
    (5.0, -1.0)
    """

    x: float
    start: float
    end: float
    """y of the two sides."""
    speed: float
    """Meters per second."""
    at: float
    """When it leaves, seconds."""

    def position(self, time: float) -> tuple[float, float]:
        return self.x, self.start + float(np.copysign(self.traveled(time), self.end - self.start))

    def traveled(self, time: float) -> float:
        """Returns meters walked by then."""
        return float(np.clip(self.speed * (time - self.at), 0, abs(self.end - self.start)))

    def pose(self, time: float, height: float) -> Pose:
        """Returns world from object, with the object's origin ``height`` meters above the road."""
        return at(*self.position(time), height, float(np.copysign(np.pi / 2, self.end - self.start)))


@dataclass(frozen=True)
class EgoDrive:
    """The recording car. It drives at y = 0 on average, sways a little and changes its speed slowly."""

    speed: float
    turn: float = 0.0
    """Degrees, of its weaving within the lane (``StreetSettings.turn``)."""

    def pose(self, time: float) -> Pose:
        """Returns world from ego: x forward, y left, z up, origin on the road under the rear axle."""
        x = self.speed * (time + 0.15 * np.sin(0.9 * time))
        y = 0.12 * np.sin(0.8 * time)
        sideways = 0.12 * 0.8 * np.cos(0.8 * time)
        if self.turn:
            weave = swing(self.speed, self.turn)
            y, sideways = y + weave * np.sin(TURNS * time), sideways + weave * TURNS * np.cos(TURNS * time)
        slope = sideways / (self.speed * (1 + 0.15 * 0.9 * np.cos(0.9 * time)))
        return at(float(x), float(y), 0.0, float(np.arctan(slope)))
