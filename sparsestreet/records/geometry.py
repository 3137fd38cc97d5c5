"""How right the geometry of a scene is: ranges along recorded lidar rays against what the lidar returned."""

from dataclasses import dataclass

WITHIN = 0.2
"""Meters of error up to which a range counts as right."""

EVERYWHERE, VEHICLES, PEOPLE, SEEN, UNSEEN = "all", "vehicles", "people", "seen", "unseen"
"""Groups of rays: all; those whose return lies in the box of a vehicle, or of a pedestrian or cyclist; those whose
return lies in an image of the instant, and the others."""

DISTANCES = {"0-10 m": (0.0, 10.0), "10-20 m": (10.0, 20.0), "20-40 m": (20.0, 40.0), "40+ m": (40.0, float("inf"))}
"""Groups of rays by their recorded range, meters: name -> from, below."""

GROUPS = (EVERYWHERE, VEHICLES, PEOPLE, SEEN, UNSEEN, *DISTANCES)


@dataclass(frozen=True)
class RangeErrors:
    """Errors of a group of rays, of all measured sweeps together. A number that has no ray to come from is None."""

    returns: int
    """Recorded returns."""
    drawn: int
    """Those whose ray meets anything in the scene."""
    median: float | None
    """Of the absolute error of the rays that meet anything, meters."""
    mean: float | None
    """The same as a mean."""
    within: float | None
    """Share of the recorded returns whose range is drawn with an error of at most ``WITHIN``."""
    chamfer: float | None
    """Mean distance of recorded points to the nearest drawn one of their sweep, plus that of drawn points to the
    nearest recorded one, meters; None also where nothing of a sweep is drawn."""

    def __post_init__(self) -> None:
        if not 0 <= self.drawn <= self.returns or (self.within is not None and not 0 <= self.within <= 1):
            raise ValueError(
                f"drawn {self.drawn} of {self.returns} returns, within {self.within}: evaluate the run again"
            )


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Errors of the ranges of some sweeps. Raises ValueError for an unknown group, and without that of all rays."""

    split: str
    """"held_out": no image, sweep or box of these instants was trained on; "training": the run holds out no instant."""
    sweeps: tuple[int, ...]
    """Integer frames of the measured sweeps."""
    strides: tuple[int, ...]
    """Of each sweep: the first return and every so many after it were measured."""
    pixel: float
    """Degrees that a pixel of the drawn views measures in their middle."""
    groups: dict[str, RangeErrors]
    """Name of a group of ``GROUPS`` -> its errors."""
    intensity_error: float | None = None
    """Mean absolute error of intensities in [0, 1], of rays drawn within ``WITHIN``; None: log or scene have none."""
    intensity_spread: float | None = None
    """The same if each had the median of the recorded ones: what knowing nothing costs."""

    def __post_init__(self) -> None:
        unknown = sorted(self.groups.keys() - set(GROUPS))
        if unknown or EVERYWHERE not in self.groups:
            raise ValueError(f"geometry has groups of {GROUPS}, and {EVERYWHERE!r}, got {sorted(self.groups)}")
        if len(self.sweeps) != len(self.strides):
            raise ValueError(f"{len(self.sweeps)} sweeps have {len(self.strides)} strides: evaluate the run again")

    @property
    def all(self) -> RangeErrors:
        """Errors of all rays."""
        return self.groups[EVERYWHERE]
