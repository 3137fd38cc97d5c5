"""The objects that the lidar of a log shows moving, as tracks of that log."""

import logging
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.tracks import with_times
from sparsestreet.geometry.boxes import box_at
from sparsestreet.naming import FOUND
from sparsestreet.tracking.find import find_objects
from sparsestreet.tracking.objects import FoundObject
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings
from sparsestreet.types import Track, View

_log = logging.getLogger(__name__)

FRAME_RATE = 10.0
"""Frames a second of a log without a clock: what most lidars turn at."""
_SAME = 1 / 3
"""Of the frames that two tracks share, the part in which their boxes overlap if they are one object."""


def found_tracks(
    log: DrivingLog, settings: TrackingSettings, held_out: frozenset[int], classes: Mapping[str, str]
) -> tuple[Track, ...]:
    """Return what moves in the lidar of a log, as ``found_1``, ``found_2``, ...; earlier runs on it keep the answer.

    Boxes at frames that are held out, or have no sweep, lie on the path between the others.

    Args:
        log: the drive; its own boxes are not looked at.
        settings: thresholds of the search.
        held_out: integer frames whose sweeps are not looked at.
        classes: kind of an object (``FoundObject.kind``) -> what the log calls its class.

    Raises ValueError for a log without lidar.
    """
    return tracks_of(log, found_objects(log, settings, held_out), classes)


def found_objects(
    log: DrivingLog, settings: TrackingSettings, held_out: frozenset[int] = frozenset()
) -> tuple[FoundObject, ...]:
    """Return what ``found_tracks`` are made of; arguments and errors as there."""
    check_lidar(log)

    def find() -> tuple[FoundObject, ...]:
        for sentence in assumptions(log):
            _log.info("%s", sentence)
        return find_objects(scans_of(log, held_out), settings, _report)

    return log.kept.get("tracks", (settings, held_out), find, FoundObject)


def check_lidar(log: DrivingLog) -> None:
    """Raise ValueError for a log in which nothing can be found."""
    if not len(log.sweeps):
        raise ValueError(
            f"tracks are found in lidar, and {log.name} has none: read its lidar (data.log.lidar=true, if it has one), "
            "or say tracks=none"
        )


def assumptions(log: DrivingLog) -> list[str]:
    """Say what is taken for granted because the log does not tell it, one sentence each."""
    said = []
    if not log.stamps:
        said.append(f"{log.name} has no clock: it is taken to have {FRAME_RATE:g} frames a second")
    if next(log.sweeps[:1].gray()).origin is None:
        said.append(f"{log.name} does not tell where its lidar stood: it is taken to be amid the cameras of each frame")
    return said


def scans_of(log: DrivingLog, held_out: frozenset[int]) -> list[Scan]:
    """Return a scan of each frame; one without points where the frame is held out or has no sweep."""
    amid = _amid_cameras(log.views)
    at = moments(log)
    scans = {frame: Scan(frame, at[frame][0], np.zeros((0, 3)), amid[frame]) for frame in amid}
    for sweep in log.sweeps.where(lambda index: index not in held_out).gray():
        origin = amid[sweep.index] if sweep.origin is None else sweep.origin.double().numpy()
        scans[sweep.index] = Scan(sweep.index, at[sweep.index][0], sweep.points.numpy(), origin)
    return [scans[frame] for frame in sorted(scans)]


def tracks_of(log: DrivingLog, objects: Sequence[FoundObject], classes: Mapping[str, str]) -> tuple[Track, ...]:
    """Return objects as tracks of the log, timed by its clock: each box is of the instant of its frame's sweep."""
    at = moments(log)
    seen: dict[int, list[float]] = {}
    for view in log.views:
        seen.setdefault(view.indices[0], []).append(view.time)
    tracks = []
    for number, each in enumerate(objects, 1):
        track = Track(
            f"{FOUND}{number}",
            classes[each.kind],
            torch.from_numpy(each.frames.astype(np.int64)),
            torch.from_numpy(each.world_from_object.astype(np.float64)),
            torch.from_numpy(each.size).float(),
            found=True,
        )
        times = [at[frame][1] for frame in track.frames.tolist()]
        tracks.append(with_times(track, times, seen) if log.stamps else track)
    return tuple(tracks)


def joined(annotated: Sequence[Track], found: Sequence[Track]) -> tuple[Track, ...]:
    """Return annotated objects and those found ones that are none of them.

    A found one is an annotated one if, seen from above, their boxes overlap in a third of the frames that have both.
    """
    return (*annotated, *(track for track in found if not any(_is_one(track, other) for other in annotated)))


def _is_one(found: Track, annotated: Track) -> bool:
    times = [0.0] * len(found.frames) if found.times is None else found.times.tolist()
    overlaps = [
        _overlap(pose, found.size, other, annotated.size)
        for frame, time, pose in zip(found.frames.tolist(), times, found.world_from_object, strict=True)
        if (other := box_at(annotated, frame, time)) is not None
    ]
    return bool(overlaps) and sum(overlaps) >= _SAME * len(overlaps)


def _overlap(one: Float64[Tensor, "4 4"], size: Tensor, other: Float64[Tensor, "4 4"], other_size: Tensor) -> bool:
    """Whether two boxes overlap in plan: of rectangles that do not, one has a side along which they lie apart."""
    corners = _corners(one, size), _corners(other, other_size)
    for pose in (one, other):
        for axis in pose[:2, :2].T:
            first, second = (part @ axis for part in corners)
            if first.max() < second.min() or second.max() < first.min():
                return False
    return True


def _corners(pose: Float64[Tensor, "4 4"], size: Tensor) -> Float64[Tensor, "4 2"]:
    signs = torch.tensor([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=torch.float64)
    return pose[:2, 3] + (signs * size[:2] / 2) @ pose[:2, :2].T


def moments(log: DrivingLog) -> dict[int, tuple[float, float]]:
    """Frame -> seconds and normalized time of its sweep; of its first image, where no stamp tells.

    Normalized time is a line through the stamps of images. No sweep is read.
    """
    first = {view.indices[0]: view for view in reversed(log.views)}
    if not log.stamps:
        return {frame: (frame / FRAME_RATE, view.time) for frame, view in first.items()}
    stamped = [(view.stamp, view.time) for view in log.views if view.stamp is not None]
    (start, low), (end, high) = min(stamped), max(stamped)
    found = {}
    for frame, view in first.items():
        stamp = log.sweeps.stamps.get(frame, view.stamp)
        assert stamp is not None  # as log.stamps says
        time = low + (high - low) * ((stamp - start) / (end - start)) if end > start else view.time
        found[frame] = (stamp - start) / 1e9, view.time if stamp == view.stamp else time
    return found


def _amid_cameras(views: Sequence[View]) -> dict[int, Float64[np.ndarray, "3"]]:
    """Frame -> the mean place of its cameras, world."""
    places: dict[int, list[np.ndarray]] = {}
    for view in views:
        places.setdefault(view.indices[0], []).append(view.camera.position.double().numpy())
    return {frame: np.mean(some, axis=0) for frame, some in places.items()}


def _report(done: int, total: int) -> None:
    """Log a line whenever another quarter is done."""
    if done * 4 // total > (done - 1) * 4 // total:
        _log.info("what moves in the lidar: %d of %d steps done", done, total)
