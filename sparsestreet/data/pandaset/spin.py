"""When the spinning lidar passed a direction: what a box that was drawn around its returns has for a stamp."""

from dataclasses import dataclass

import numpy as np

_SURE = 0.9
"""Mean length of the unit vectors whose direction is the phase, of 1 for a lidar that turns evenly."""


@dataclass(frozen=True)
class Spin:
    """An even turn of a lidar: azimuth over time."""

    period: float
    """Seconds."""
    direction: int
    """1: counterclockwise seen from above, -1: clockwise."""
    phase: float
    """Radians: 2 pi t / period = direction * azimuth + phase, but for whole turns."""
    middle: float
    """Seconds from the stamp of a sweep to the middle of its turn."""

    def passing(self, azimuths: np.ndarray) -> np.ndarray:
        """Seconds from the stamp of the sweep to the instants at which the beam has these azimuths (radians)."""
        since = self.direction * azimuths + self.phase - 2 * np.pi * self.middle / self.period
        return self.middle + self.period * ((since / (2 * np.pi) + 0.5) % 1 - 0.5)


def spin_of(azimuths: np.ndarray, seconds: np.ndarray, period: float) -> Spin | None:
    """The turn that returns show: which way, and when ahead; None where they show none.

    Args:
        azimuths: of the returns in the frame of the lidar, radians.
        seconds: from the stamp of the sweep to each return.
        period: seconds of a turn.
    """
    # Points of another data set, written in this one's layout, are where they were at one instant.
    if not len(azimuths) or seconds.min() == seconds.max():
        return None
    middle = (seconds.min() + seconds.max()) / 2
    turns = 2 * np.pi * seconds / period
    sums = {direction: np.exp(1j * (turns - direction * azimuths)).mean() for direction in (1, -1)}
    direction = max(sums, key=lambda one: abs(sums[one]))
    if abs(sums[direction]) < _SURE:
        return None
    return Spin(period, direction, float(np.angle(sums[direction])), float(middle))
