"""The stamps of what a log holds, for whoever writes it down: a log tells normalized times, a layout wants stamps."""

from dataclasses import dataclass, replace

import torch

from sparsestreet.data.log import DrivingLog
from sparsestreet.types import Track, View

_SECOND = 1_000_000_000
_PERIOD = 100_000_000
"""Nanoseconds between the frames of a log without a clock: 10 a second, as most logs have."""


@dataclass(frozen=True)
class LogTimes:
    """Nanoseconds of normalized times, and back. A log without a clock gets 10 frames a second, from 1 s on."""

    first: int
    """Of normalized time 0."""
    span: int
    """From normalized time 0 to 1."""
    invented: bool
    """Whether the log has no clock."""
    shift: int
    """Whole seconds, in nanoseconds, that were added to the log's own stamps."""

    @classmethod
    def of(cls, log: DrivingLog, earliest: int | None = None) -> "LogTimes":
        """``earliest``: the least stamp that the layout can hold; stamps before it are moved by whole seconds."""
        known = [(view.time, view.stamp) for view in log.views if view.stamp is not None]
        if not known:
            return cls(_SECOND, _PERIOD * max(log.num_frames - 1, 1), True, 0)
        (early, begin), (late, end) = min(known), max(known)
        if early == late:
            others = ((sweep.time, sweep.stamp) for sweep in log.sweeps.gray() if sweep.stamp is not None)
            late, end = next((one for one in others if one[0] != early), (late, end))
        span = round((end - begin) / (late - early)) if late != early else 0
        first = begin - round(early * span)
        shift = 0 if earliest is None or first >= earliest else -((first - earliest) // _SECOND) * _SECOND
        return cls(first + shift, span, False, shift)

    def stamp(self, time: float) -> int:
        return self.first + round(time * self.span)

    def time(self, stamp: int) -> float:
        """Normalized time of a stamp; outside of [0, 1] where it lies outside of the log."""
        return (stamp - self.first) / max(self.span, 1)

    def of_view(self, view: View) -> int:
        return self.stamp(view.time) if view.stamp is None else view.stamp + self.shift

    def timed(self, track: Track, num_frames: int) -> Track:
        """The track with the times of its boxes, also in a log without a clock."""
        return (
            track if track.times is not None else replace(track, times=track.frames.double() / max(num_frames - 1, 1))
        )

    def losses(self) -> tuple[str, ...]:
        """What of the log's stamps is not written."""
        if self.invented:
            return ("the log has no clock: its frames get stamps 0.1 s apart, from 1 s on",)
        if self.shift:
            return (f"all stamps are {self.shift // _SECOND} s later: the layout has none before 0",)
        return ()


def stamps_of_frames(log: DrivingLog, times: LogTimes) -> tuple[int, ...]:
    """Of each frame: the stamp of its sweep, or of the middle one of its images where it has none. Reads all points.

    Raises ValueError for a frame with neither, and for stamps that do not increase.
    """
    found: dict[int, int] = {
        sweep.index: times.stamp(sweep.time) if sweep.stamp is None else sweep.stamp + times.shift
        for sweep in log.sweeps.gray()
    }
    seen: dict[int, list[int]] = {}
    for view in log.views:
        seen.setdefault(view.indices[0], []).append(times.of_view(view))
    found |= {frame: sorted(some)[len(some) // 2] for frame, some in seen.items() if frame not in found}
    if absent := sorted(set(range(log.num_frames)) - found.keys()):
        raise ValueError(f"frames {absent[:5]} of {log.name!r} have no image and no sweep: read only those that have")
    stamps = torch.tensor([found[frame] for frame in range(log.num_frames)])
    late = torch.nonzero(stamps[1:] <= stamps[:-1]).flatten()
    if len(late):
        raise ValueError(f"the stamps of frames {int(late[0])} and {int(late[0]) + 1} of {log.name!r} do not increase")
    return tuple(stamps.tolist())
