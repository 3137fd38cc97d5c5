"""Ways of edited objects: their recorded way moved, a moment of it held, or a way of their own.

An object's frame has x ahead, y left and z up. Matrices are world_from_object, float64; times are normalized.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

Frame = Float64[np.ndarray, "4 4"]
Recorded = Callable[[float], Frame]
"""Where the object was at a time, as it was recorded; before and after its life at its first and last place."""

_STEP = 1e-3
"""Of normalized time, for directions of travel."""
_SLOW = 0.1
"""Meters in a normalized time of 1 below which a thing stands: its direction of travel is noise."""


def placed(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Frame:
    """A level frame at a place in the world, meters, turned to the left from +x by ``yaw`` radians.

    >>> placed(1.0, 2.0, 0.0, 0.0)[:3, 3].tolist()
    [1.0, 2.0, 0.0]
    """
    frame = np.eye(4)
    frame[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    frame[:3, 3] = x, y, z
    return frame


class Path(ABC):
    """Where an edited object is at a time."""

    @abstractmethod
    def frame(self, time: float, recorded: Recorded) -> Frame:
        """world_from_object at a time."""

    def clock(self, time: float) -> float:
        """The time that the object's own shape has then: how a person walks, what a network changes."""
        return time


@dataclass(frozen=True)
class AsRecorded(Path):
    """The recorded way."""

    def frame(self, time: float, recorded: Recorded) -> Frame:
        return recorded(time)


@dataclass(frozen=True)
class Moved(Path):
    """The recorded way, moved and turned in the object's own frame: at once, or smoothly between two times.

    On the way from one to the other it also turns into the direction in which it drives.
    """

    forward: float = 0.0
    right: float = 0.0
    up: float = 0.0
    """Meters."""
    turn: float = 0.0
    """To the left, radians."""
    during: tuple[float, float] | None = None
    """From when to when, normalized times; None: it has always been there."""

    def __post_init__(self) -> None:
        if self.during is not None and not self.during[0] < self.during[1]:
            raise ValueError(f"a move takes from one time to a later one, got {self.during[0]:g} to {self.during[1]:g}")

    def frame(self, time: float, recorded: Recorded) -> Frame:
        moved = self._beside(time, recorded)
        if self.during is not None and self.during[0] < time < self.during[1]:
            before, after = (recorded(time + side * _STEP / 2) for side in (-1, 1))
            moved_before, moved_after = (self._beside(time + side * _STEP / 2, recorded) for side in (-1, 1))
            old, new = after[:3, 3] - before[:3, 3], moved_after[:3, 3] - moved_before[:3, 3]
            if np.linalg.norm(old[:2]) > _SLOW * _STEP:
                yaw = np.arctan2(new[1], new[0]) - np.arctan2(old[1], old[0])
                moved[:3, :3] = placed(yaw=float(yaw))[:3, :3] @ moved[:3, :3]
        return moved

    def _beside(self, time: float, recorded: Recorded) -> Frame:
        share = self._share(time)
        own = placed(share * self.forward, -share * self.right, share * self.up, share * self.turn)
        return recorded(time) @ own

    def _share(self, time: float) -> float:
        if self.during is None:
            return 1.0
        start, end = self.during
        s = float(np.clip((time - start) / (end - start), 0, 1))
        return s * s * (3 - 2 * s)


@dataclass(frozen=True)
class Held(Path):
    """It stands as it was at one time."""

    at: float

    def frame(self, time: float, recorded: Recorded) -> Frame:
        return recorded(self.at)

    def clock(self, time: float) -> float:
        return self.at


@dataclass(frozen=True)
class Driven(Path):
    """A way of its own: level frames at increasing times, between them straight and evenly.

    Before the first and after the last time it stands there. Raises ValueError for times that do not increase.
    """

    times: Sequence[float]
    positions: Sequence[tuple[float, float]]
    """x and y of the frame's origin in the world, meters."""
    heights: Sequence[float] | None = None
    """Its z; None: the recorded ones."""
    yaws: Sequence[float] | None = None
    """To the left from +x, radians; None: the direction of travel, and where it stands that before."""

    def __post_init__(self) -> None:
        if not self.times or any(a >= b for a, b in zip(self.times, self.times[1:], strict=False)):
            raise ValueError(f"a way has a place at each of increasing times, got times {list(self.times)}")
        for name in ("positions", "heights", "yaws"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.times):
                raise ValueError(f"a way has {name} for each of its {len(self.times)} times, got {len(values)}")

    def frame(self, time: float, recorded: Recorded) -> Frame:
        x, y = (float(np.interp(time, self.times, [place[axis] for place in self.positions])) for axis in (0, 1))
        z = float(recorded(time)[2, 3] if self.heights is None else np.interp(time, self.times, self.heights))
        return placed(x, y, z, self._yaw(time))

    def _yaw(self, time: float) -> float:
        if self.yaws is not None:
            return float(np.interp(time, self.times, np.unwrap(self.yaws)))
        yaw = 0.0
        moves = np.diff(np.array(self.positions, np.float64), axis=0)
        legs = [(start, move) for start, move in zip(self.times, moves, strict=False) if np.linalg.norm(move) > 1e-3]
        for number, (start, move) in enumerate(legs):
            if number == 0 or start <= time:
                yaw = float(np.arctan2(move[1], move[0]))
        return yaw


@dataclass(frozen=True)
class Given(Path):
    """Frames at one or two times, such as the ends of an exposure; turned along the shorter arc between them."""

    start: Frame
    end: Frame | None = None
    times: tuple[float, float] = (0.0, 1.0)

    def frame(self, time: float, recorded: Recorded) -> Frame:
        if self.end is None or self.times[0] >= self.times[1]:
            return self.start
        share = float(np.clip((time - self.times[0]) / (self.times[1] - self.times[0]), 0, 1))
        return between(self.start, self.end, share)


def between(start: Frame, end: Frame, share: float) -> Frame:
    """A frame at a share of the way between two, straight and turned along the shorter arc."""
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    frame = np.eye(4)
    frame[:3, :3] = start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    frame[:3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return frame


def along(times: Sequence[float], frames: Float64[np.ndarray, "n 4 4"], time: float) -> Frame:
    """Return the frame at a time between those that are known; before and after them it stands at their ends."""
    after = int(np.searchsorted(times, time))
    if after in (0, len(times)):
        return frames[min(after, len(times) - 1)]
    before = after - 1
    return between(frames[before], frames[after], (time - times[before]) / (times[after] - times[before]))
