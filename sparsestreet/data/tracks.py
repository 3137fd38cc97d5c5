"""Tracks of annotated objects: checked, cut to the frames that are read, and timed by the log's clock."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.poses import are_rigid, check_rigid, recentered
from sparsestreet.data.problems import fault
from sparsestreet.data.timestamps import LogClock
from sparsestreet.types import Track, View


def repeated(names: Sequence[str]) -> str | None:
    """Return the first name that stands twice; None where there is none."""
    return next((name for name, count in Counter(names).items() if count > 1), None)


def checked_track(
    name: str,
    class_name: str,
    frames: np.ndarray,
    poses: np.ndarray,
    sizes: np.ndarray,
    *,
    path: Path,
    num_frames: int | None,
) -> Track:
    """An object whose size is the mean over its boxes. Raises LogError, naming the file, for boxes that cannot be.

    Args:
        name: of the object.
        class_name: as the data set calls it.
        frames: f integer frames, strictly increasing.
        poses: world_from_object of each, f x 4 x 4: x along the length, y left, z up, origin at the center of the box.
        sizes: length, width, height of each, f x 3, meters.
        path: the file that the boxes are from.
        num_frames: of the log; None: frames may lie outside of it.
    """
    what, count = f"object {name}", len(frames)
    if count == 0:
        raise fault(
            path, f"{what} ({class_name}) has no frames", "remove it, or write the frames that its boxes are from"
        )
    if poses.shape != (count, 4, 4) or sizes.shape != (count, 3):
        message = f"{what} has {count} frames, but poses {poses.shape} and sizes {sizes.shape}"
        raise fault(
            path, message, f"write a 4x4 pose and three lengths for each frame: ({count}, 4, 4) and ({count}, 3)"
        )
    _check_frames(frames, path, what, num_frames)
    if not (sizes > 0).all() or not np.isfinite(sizes).all():
        message = f"{what} has a box of {sizes.min(axis=0).round(3).tolist()} m (smallest length, width, height)"
        raise fault(path, message, "write positive lengths in meters, or drop the box")
    if not are_rigid(torch.from_numpy(poses)):
        for frame, pose in zip(frames.astype(int), torch.from_numpy(poses), strict=True):
            check_rigid(pose, path, f"the pose of {what} at frame {frame}")
    size = torch.from_numpy(sizes).mean(0).float()
    return Track(name, class_name, torch.from_numpy(frames.astype(np.int64)), torch.from_numpy(poses), size)


def track_in_window(track: Track, frames: Sequence[int], origin: Float64[Tensor, "3"]) -> Track | None:
    """The track in these frames, which increase, counted by their places, in the re-centered world; None where it is
    absent.

    The size stays the mean over all of the log: an object does not change with the window.
    """
    wanted = torch.tensor(frames)
    inside = torch.isin(track.frames, wanted)
    if not inside.any():
        return None
    poses = recentered(track.world_from_object[inside], origin)
    body = None
    if track.body is not None:
        body = replace(track.body, rotations=track.body.rotations[inside], valid=track.body.valid[inside])
    return replace(track, frames=torch.searchsorted(wanted, track.frames[inside]), world_from_object=poses, body=body)


def timed_tracks(
    tracks: Sequence[Track],
    clock: LogClock,
    views: Sequence[View],
    stamps: Mapping[str, Sequence[int]] | None = None,
) -> tuple[Track, ...]:
    """Tracks of the window with normalized times; as they are where the log has no clock.

    Args:
        tracks: frames counted from the start of the window.
        clock: of the log; it knows all stamps.
        views: of the log. An object is there from the first to the last of them in its annotated frames.
        stamps: name of an object -> nanoseconds of each of its boxes in the window; others have those of their frames.
    """
    if clock.stamps is None:
        return tuple(tracks)
    seen: dict[int, list[float]] = {}
    for view in views:
        seen.setdefault(view.indices[0], []).append(view.time)
    return tuple(_timed(track, clock, seen, (stamps or {}).get(track.name)) for track in tracks)


def _timed(track: Track, clock: LogClock, seen: Mapping[int, Sequence[float]], stamps: Sequence[int] | None) -> Track:
    frames = track.frames.tolist()
    own = [None] * len(frames) if stamps is None else stamps
    return with_times(track, [clock.time(frame, stamp) for frame, stamp in zip(frames, own, strict=True)], seen)


def with_times(track: Track, times: Sequence[float], seen: Mapping[int, Sequence[float]]) -> Track:
    """Return the track with the normalized times of its boxes, and the span that follows.

    ``seen``: frame -> normalized times of its images.
    """
    frames = track.frames.tolist()
    first, last = min((times[0], *seen.get(frames[0], ()))), max((times[-1], *seen.get(frames[-1], ())))
    return replace(track, times=torch.tensor(times, dtype=torch.float64), span=(first, last))


def _check_frames(frames: np.ndarray, path: Path, what: str, num_frames: int | None) -> None:
    if frames.ndim != 1 or not (frames % 1 == 0).all() or not (np.diff(frames) > 0).all():
        message = f"{what} has frame_idx {frames.tolist()[:5]} ..., not strictly increasing integers"
        raise fault(path, message, "sort its boxes by frame and keep one a frame")
    if num_frames is not None and (frames[0] < 0 or frames[-1] >= num_frames):
        message = f"{what} has boxes at frames {frames[0]:g} to {frames[-1]:g}, the log ends at {num_frames - 1}"
        raise fault(path, message, "number frames from 0 as the images are, or drop the boxes behind the end")
