"""A spinning lidar: the directions of its beams, their range and their losses."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class LidarSensor:
    """A lidar that turns about the vertical axis. Raises ValueError for values that no sensor has."""

    name: str
    elevations: Sequence[float]
    """(lowest, highest) beam, degrees above the horizon; the other beams are evenly spread between them."""
    beams: int
    azimuth_steps: int
    """Number of rays of one beam in a full turn; three cameras of 60 degrees see about 40 percent of them."""
    max_range: float
    """Meters; farther surfaces give no return."""
    noise: float
    """Standard deviation of the measured range, meters."""
    dropout: float
    """Probability that a return is lost, independently of the others, in [0, 1)."""
    height: float
    """Height above the ground on the ego car, meters."""

    def __post_init__(self) -> None:
        for name in ("beams", "azimuth_steps", "max_range", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"LidarSensor.{name} must be positive but is {getattr(self, name)}")
        if not self.noise >= 0:
            raise ValueError(f"LidarSensor.noise must not be negative but is {self.noise}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"LidarSensor.dropout must lie in [0, 1) but is {self.dropout}")
        # A list from a config file becomes a tuple, so that equal sensors compare equal.
        object.__setattr__(self, "elevations", tuple(float(elevation) for elevation in self.elevations))
        ends = (-90.0, *self.elevations, 90.0)
        if len(ends) != 4 or not ends[0] < ends[1] <= ends[2] < ends[3]:
            raise ValueError(
                "LidarSensor.elevations must be the lowest and the highest beam's degrees within (-90, 90) but is "
                f"{list(self.elevations)}"
            )


WAYMO_TOP = LidarSensor(
    name="waymo_top",
    elevations=(-17.6, 2.4),
    beams=64,
    azimuth_steps=662,
    max_range=75.0,
    noise=0.02,
    dropout=0.05,
    height=1.9,
)
"""The default sensor; conf/data/lidar/waymo_top.yaml names the source of the numbers."""
