"""The instants of a drive: when its lidar faced forward, which is when it triggered the cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low

from sparsestreet.data.kitti.layout import Drive
from sparsestreet.data.kitti.text import read_stamps
from sparsestreet.data.problems import Problem, fault

_REMEDY = "copy it again from the published archive, or read other frames (data.log.first_frame, .last_frame)"


@dataclass(frozen=True)
class DriveClock:
    """Nanoseconds of the window's frames, and what was missing."""

    stamps: tuple[int, ...]
    notes: tuple[str, ...]


def read_clock(drive: Drive) -> DriveClock:
    """Stamps of the lidar, those of images less their usual lag where the lidar has none.

    The images' own stamps are the recording computer's: in drive 2011_09_26_0005 they are 10 to 17 ms late, by another
    time for each camera.
    Raises LogError for files that give no increasing stamps.
    """
    path = drive.image_stamps(drive.cameras[0])
    images = at_frames(read_stamps(path), drive.frames)
    if not drive.lidar_stamps().is_file():
        return DriveClock(increasing(images, drive.frames, path), ("no clock of the lidar: the images' one is taken",))
    lidar = at_frames(read_stamps(drive.lidar_stamps()), drive.frames)
    lags = [image - turn for image, turn in zip(images, lidar, strict=True) if image is not None and turn is not None]
    if not lags:
        message = f"frames {drive.frames[0]} to {drive.frames[-1]} have no stamps"
        raise fault(drive.lidar_stamps(), message, _REMEDY)
    lag, filled = median_low(lags), sum(turn is None for turn in lidar)
    stamps = [
        turn if turn is not None or image is None else image - lag for image, turn in zip(images, lidar, strict=True)
    ]
    note = f"{filled} frames without a stamp of the lidar: the image's, less its usual lag, is taken"
    return DriveClock(increasing(stamps, drive.frames, drive.lidar_stamps()), (note,) if filled else ())


def read_turns(drive: Drive, clock: DriveClock) -> tuple[dict[int, tuple[int, int]], list[Problem]]:
    """Begin and end of the lidar's turn at each frame of the window that has a sweep, and what is wrong with them."""
    first, last = (drive.lidar_stamps(which) for which in ("_start", "_end"))
    begins, ends = (at_frames(read_stamps(path), drive.frames) for path in (first, last))
    turns, problems = {}, []
    for place, frame in enumerate(drive.frames):
        if not drive.sweep(frame).is_file():
            continue
        begin, stamp, end = begins[place], clock.stamps[place], ends[place]
        if begin is None or end is None:
            path = first if begin is None else last
            problems.append(Problem(path, f"frame {frame} has a sweep, and no stamp here", _REMEDY))
        elif not (begin <= stamp <= end and end - begin < 1_000_000_000):
            message = f"at frame {frame} the turn from {begin} to {end} ns is no second around {stamp} ns"
            problems.append(Problem(first, message, _REMEDY))
        else:
            turns[frame] = begin, end
    return turns, problems


def at_frames(stamps: Sequence[int | None], frames: range) -> list[int | None]:
    """Line k is that of frame k; None where a file ends early."""
    return [stamps[frame] if frame < len(stamps) else None for frame in frames]


def increasing(stamps: Sequence[int | None], frames: Sequence[int], path: Path) -> tuple[int, ...]:
    """Raises LogError unless each frame has a stamp, later than the one before."""
    found: list[int] = []
    for frame, stamp in zip(frames, stamps, strict=True):
        if stamp is None:
            raise fault(path, f"line {frame + 1}, of frame {frame}, is empty or missing", _REMEDY)
        if found and stamp <= found[-1]:
            raise fault(path, f"line {frame + 1}, of frame {frame}, is not later than the one before", _REMEDY)
        found.append(stamp)
    return tuple(found)
