"""What a spinning lidar is: where its beams point, how far they reach and what they lose."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class LidarSensor:
    """A lidar that turns about the vertical axis. Raises ValueError for values that no sensor has."""

    name: str
    elevations: Sequence[float]
    """(lowest, highest) beam, degrees above the horizon; the others are evenly spread between them."""
    beams: int
    azimuth_steps: int
    """Rays of one beam in a full turn; about 40 percent of them look where three cameras of 60 degrees appearance."""
    max_range: float
    """Meters; what is farther away gives no return."""
    noise: float
    """Standard deviation of the measured range, meters."""
    dropout: float
    """Share of the returns that is lost, each by its own chance, in [0, 1)."""
    height: float
    """Above the ground on the ego car, meters."""

    def __post_init__(self) -> None:
        for name in ("beams", "azimuth_steps", "max_range", "height"):
            if not getattr(self, name) > 0:
                raise ValueError(f"LidarSensor.{name} must be positive but is {getattr(self, name)}")
        if not self.noise >= 0:
            raise ValueError(f"LidarSensor.noise must not be negative but is {self.noise}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"LidarSensor.dropout must lie in [0, 1) but is {self.dropout}")
        # A list (as a config file gives it) becomes a tuple, so that equal sensors compare equal.
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
"""The default; conf/data/lidar/waymo_top.yaml says where the numbers come from."""
