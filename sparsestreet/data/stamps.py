"""The stamps of what a log holds, for whoever writes it down: a log itself counts in normalized time."""

from collections.abc import Sequence
from decimal import Decimal

from jaxtyping import Int64
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.types import Track


def frame_stamps(log: DrivingLog) -> tuple[int, ...] | None:
    """Nanoseconds of each frame: of its sweep, where there is one, else of its earliest image; None without a clock."""
    if len(log.stamps) < log.num_frames:
        return None
    return tuple(log.sweeps.stamps.get(index, log.stamps[index]) for index in range(log.num_frames))


def box_stamps(log: DrivingLog, track: Track) -> Int64[Tensor, " f"] | None:
    """Nanoseconds of each box of an object; None where they are those of its frames, or the log has no clock.

    Normalized time is a line through the stamps of the views; doubles hold it to a nanosecond.
    """
    if track.times is None or not log.stamps:
        return None
    timed = [(view.stamp, view.time) for view in log.views if view.stamp is not None]
    (first, start), (last, end) = min(timed), max(timed)
    if first == last:  # one instant tells nothing of others
        return None
    since = ((track.times - start) * ((last - first) / (end - start))).round().long()
    return first + since


def seconds_lines(stamps: Sequence[int]) -> bytes:
    """Nanoseconds as decimal seconds, a line each, with all of their digits."""
    return "".join(f"{Decimal(stamp).scaleb(-9):.9f}\n" for stamp in stamps).encode()
