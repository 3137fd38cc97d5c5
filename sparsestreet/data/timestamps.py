"""When the frames of a log were recorded: normalized time, and seconds and stamps where the log has a clock."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from pathlib import Path

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import fault
from sparsestreet.types import Camera, View

_PER_SECOND = 1_000_000_000
_LARGEST = 2**63
"""Nanoseconds: what 64 bits hold, 292 years."""
_REMEDY = "write the seconds of each frame on a line of its own, or remove the file to read the log without a clock"


@dataclass(frozen=True)
class LogClock:
    """The times of what was recorded. Raises ValueError for stamps of another number, or that do not increase.

    Normalized time runs from the least stamp of anything in the window to the largest. Without a clock it is
    frame / (frames - 1). Evenly spaced stamps that all images of a frame share give the same.
    """

    num_frames: int
    stamps: tuple[int, ...] | None = None
    """Of each frame, nanoseconds on the log's own clock; None: the log has no clock."""
    others: Sequence[int] = ()
    """Those of images, sweeps and boxes of the window that have stamps of their own."""

    def __post_init__(self) -> None:
        if self.stamps is not None and (problem := _disorder(self.stamps, self.num_frames)):
            raise ValueError(f"{problem}: give one stamp for each frame, in order")

    def view(self, camera: Camera, frame_index: int, camera_index: int, stamp: int | None = None) -> View:
        """A recorded view; ``stamp`` is that of the image, where it is not its frame's."""
        time = self.time(frame_index, stamp)
        if camera.shutter is not None and self.stamps is not None:
            camera = replace(camera, shutter=replace(camera.shutter, span=self._span(camera.shutter.seconds)))
        return View(camera, time, frame_index, camera_index, *self.moment(frame_index, stamp))

    def time(self, frame_index: int, stamp: int | None = None) -> float:
        """Normalized time of a frame, or of what was recorded with it at a stamp of its own; 0 in a log of one instant.

        Raises ValueError for a stamp outside of those that the clock was made with.
        """
        if self.stamps is None:
            return frame_index / max(self.num_frames - 1, 1)
        first, last = self._reach
        stamp = self.stamps[frame_index] if stamp is None else stamp
        if not first <= stamp <= last:
            raise ValueError(f"stamp {stamp} lies outside of the clock's {first} to {last}: name it in LogClock.others")
        return (stamp - first) / max(last - first, 1)

    def _span(self, seconds: float) -> float:
        """Normalized time that so many seconds are; 0 in a log of one instant."""
        first, last = self._reach
        return seconds * _PER_SECOND / (last - first) if last > first else 0.0

    @cached_property
    def _reach(self) -> tuple[int, int]:
        every = (*(self.stamps or ()), *self.others)
        return min(every), max(every)

    def moment(self, frame_index: int, stamp: int | None = None) -> tuple[float | None, int | None]:
        """Seconds since the first frame, and stamp, of a frame or of what was recorded with it.

        An image that was taken before the stamp of the first frame has negative seconds.
        """
        if self.stamps is None:
            return None, None
        stamp = self.stamps[frame_index] if stamp is None else stamp
        # Integers are subtracted before anything is rounded: 1.5e9 seconds would leave a double 0.2 microseconds.
        return (stamp - self.stamps[0]) / _PER_SECOND, stamp


def read_stamps(path: Path, num_frames: int) -> tuple[int, ...]:
    """The decimal seconds of a text file, one line a frame, in nanoseconds.

    Raises LogError for another number of lines, a line that is no number, or stamps that do not increase.
    """
    try:
        check_regular(path)
        lines = [line.strip() for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise fault(path, f"the file cannot be read ({error})", _REMEDY) from error
    stamps = tuple(_nanoseconds(line, path) for line in lines)
    if problem := _disorder(stamps, num_frames):
        raise fault(path, problem, _REMEDY)
    return stamps


def _nanoseconds(line: str, path: Path) -> int:
    try:
        seconds = Decimal(line)
    except ArithmeticError as error:
        raise fault(path, f"{line[:40]!r} is no number of seconds", _REMEDY) from error
    if not seconds.is_finite() or seconds.copy_abs() > _LARGEST // _PER_SECOND:
        raise fault(path, f"{line[:40]!r} is no number of seconds that a clock can show", _REMEDY)
    return int((seconds * _PER_SECOND).to_integral_value())


def _disorder(stamps: tuple[int, ...], num_frames: int) -> str | None:
    """What is wrong with the stamps of a log, if anything."""
    if len(stamps) != num_frames:
        return f"a log of {num_frames} frames has {num_frames} stamps, got {len(stamps)}"
    for index in range(1, num_frames):
        before, after = stamps[index - 1], stamps[index]
        if after <= before:
            lag = (before - after) / _PER_SECOND
            return f"stamps must increase, but frame {index} lies {lag:g} s before frame {index - 1}"
    return None
