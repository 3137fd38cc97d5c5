"""Latitudes and longitudes of places in a world, such that KITTI's readers find this world again."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.kitti.oxts import EARTH_RADIUS


@dataclass(frozen=True)
class Mercator:
    """Mercator's plane at the scale of one latitude: the inverse of ``Oxts.world_from_imu``."""

    latitude: float
    """Degrees, of the first frame of a drive."""
    LOWEST: ClassVar[float] = -100.0
    HIGHEST: ClassVar[float] = 9000.0
    """Meters that places may lie high."""

    @staticmethod
    def through(place: Float64[np.ndarray, "3"]) -> "Mercator | None":
        """The plane in which a drive that starts at this place has it there; None where there is none.

        With the scale of its own latitude p, a place lies r cos(p) artanh(sin(p)) north of the equator. This grows up
        to 4,227 km at 56.5 degrees, and falls beyond: latitudes below are taken.
        """
        east, north, up = place.tolist()
        low, high = 0.0, _FARTHEST
        if abs(north) > _north(high) or not Mercator.LOWEST <= up <= Mercator.HIGHEST:
            return None
        for _ in range(100):
            middle = (low + high) / 2
            low, high = (middle, high) if _north(middle) < abs(north) else (low, middle)
        found = Mercator(math.copysign(high, north))
        return found if abs(found.longitude(east)) <= 180 else None

    @property
    def _radius(self) -> float:
        return float(np.cos(np.radians(self.latitude))) * EARTH_RADIUS

    def longitude(self, east: float) -> float:
        return math.degrees(east / self._radius)

    def latitude_of(self, north: float) -> float:
        return 2 * math.degrees(math.atan(math.exp(north / self._radius))) - 90


_FARTHEST = 56.465
"""Degrees where artanh(sin p) = 1 / sin p, above which one latitude north is farther south in its own plane."""


def _north(latitude: float) -> float:
    """Meters north of the equator at the scale of the latitude itself."""
    sine = math.sin(math.radians(latitude))
    return EARTH_RADIUS * math.cos(math.radians(latitude)) * math.atanh(sine)
