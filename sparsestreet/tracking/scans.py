"""What a lidar saw at one instant, and all that is seen at the instants of a drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64


@dataclass(frozen=True)
class Scan:
    """The returns of one lidar in one frame. Raises ValueError for numbers that are not finite."""

    frame: int
    """Integer frame; several lidars have several scans of one frame."""
    seconds: float
    """Time, on a clock that all scans share."""
    points: Float[np.ndarray, "n 3"]
    """Returns in the world, meters; z is up; float32 or float64. None at all: the frame was not looked at, but has a
    time."""
    origin: Float64[np.ndarray, "3"]
    """Where the lidar stood, in the world."""

    def __post_init__(self) -> None:
        finite = np.isfinite(self.seconds) and np.isfinite(self.origin).all() and np.isfinite(self.points).all()
        if not finite:
            broken = int((~np.isfinite(self.points)).any(1).sum())
            raise ValueError(
                f"a scan needs finite points, origin and seconds, but frame {self.frame} has {broken} broken of "
                f"{len(self.points)} points, origin {self.origin.tolist()}, {self.seconds} s: drop these returns"
            )


@dataclass(frozen=True)
class Returns:
    """What came back at one instant, to all its lidars."""

    points: Float64[np.ndarray, "n 3"]
    origins: Float64[np.ndarray, "n 3"]
    """Where the lidar of each return stood."""

    def __len__(self) -> int:
        return len(self.points)

    def where(self, chosen: Bool[np.ndarray, " n"] | Int64[np.ndarray, " k"]) -> "Returns":
        """Return those of a mask or of row numbers."""
        return Returns(self.points[chosen], self.origins[chosen])

    def thinned(self, most: int) -> "Returns":
        """Return at most ``most`` of them, evenly from first to last."""
        step = -(-len(self) // most) if len(self) else 1
        return Returns(self.points[::step], self.origins[::step])

    @staticmethod
    def joined(parts: Sequence["Returns"]) -> "Returns":
        """Return all of several; none at all is no error."""
        none = np.zeros((0, 3))
        points, origins = ([none, *(getattr(part, name) for part in parts)] for name in ("points", "origins"))
        return Returns(np.concatenate(points), np.concatenate(origins))


def instants(scans: Sequence[Scan]) -> list[list[Scan]]:
    """Return the scans of each frame, in the order of frames.

    Raises ValueError where time does not increase from frame to frame; the time of a frame is the mean of its scans.
    """
    ordered = sorted(scans, key=lambda scan: scan.frame)
    groups = [list(group) for _, group in groupby(ordered, key=lambda scan: scan.frame)]
    seconds = instant_seconds(groups)
    if (late := np.flatnonzero(np.diff(seconds) <= 0)).size:
        before, after = groups[late[0]][0].frame, groups[late[0] + 1][0].frame
        raise ValueError(
            f"the seconds of scans must increase with their frames, but frame {before} is at {seconds[late[0]]:g} s "
            f"and frame {after} at {seconds[late[0] + 1]:g} s: sort the scans by time, or correct their clock"
        )
    return groups


def instant_seconds(groups: Sequence[Sequence[Scan]]) -> Float64[np.ndarray, " t"]:
    """Return the time of each frame's scans, their mean, seconds."""
    return np.array([np.mean([scan.seconds for scan in group]) for group in groups], np.float64)
