"""Bodies of the people of a log whom nobody posed: each walks along its boxes, as its lidar returns show best."""

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import box_at, inside_box
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.tracking.gait import Walk
from sparsestreet.tracking.gait_fit import MIN_RETURNS, Seen
from sparsestreet.tracking.street import FRAME_RATE
from sparsestreet.types import BodyPoses, Sweep, Track

_log = logging.getLogger(__name__)

_BOX_FROM_BODY = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""A body's z is ahead, the box's x; its x is the box's y, and its y is up."""
_MAX_RETURNS = 1000
"""Of a person, evenly from first to last."""
_GROUND = 0.08
"""Meters above the lower side of a box up to which a return may be of the ground."""


def with_bodies(log: DrivingLog, held_out: frozenset[int], classes: Collection[str]) -> DrivingLog:
    """Return the log with a body for each object of the classes that has none.

    Boxes and sweeps of held-out frames are not looked at, and have no pose. Earlier runs on the log keep the answer.
    """
    bare = [track for track in log.tracks if track.body is None and track.class_name in classes]
    bare = [track for track in bare if any(frame not in held_out for frame in track.frames.tolist())]
    found = log.kept.get("bodies", (bare, held_out), lambda: _bodies(log, bare, held_out), BodyPoses)
    bodies = dict(zip((track.name for track in bare), found, strict=True))
    # No box changes, so whatever they carry and whatever is kept stays as it is.
    return replace(log, tracks=tuple(replace(track, body=bodies.get(track.name, track.body)) for track in log.tracks))


@dataclass(frozen=True)
class _Person:
    """A track without the frames that are held out, and its returns."""

    track: Track
    trained: Track
    seconds: Float64[np.ndarray, " f"]
    """Of the boxes of ``track``."""
    returns: list[tuple[float, Float64[Tensor, "n 3"]]] = field(default_factory=list)
    """Seconds, and places in the box."""

    def look(self, sweep: Sweep, seconds: float) -> None:
        """Add the returns in the box of a sweep, where it has one."""
        box, size = box_at(self.trained, sweep.index, sweep.time), self.track.size
        if box is not None:
            near = ((sweep.points - box[:3, 3]).abs() < size.norm()).all(1)
            points = transform_points(inverse(box), sweep.points[near].double())
            self.returns.append((seconds, points[inside_box(points, size) & (points[:, 2] > _GROUND - size[2] / 2)]))

    def body(self, held_out: frozenset[int]) -> BodyPoses:
        """Return the body of the likeliest gait."""
        height = float(self.track.size[2])
        used = np.array([frame not in held_out for frame in self.track.frames.tolist()])
        walk = Walk.along(self.seconds[used], self.trained.world_from_object[:, :2, 3].numpy(), height)
        points = torch.cat([points for _, points in self.returns] or [torch.zeros(0, 3, dtype=torch.float64)])
        counts = torch.tensor([len(points) for _, points in self.returns], dtype=torch.int64)
        moments = torch.arange(len(counts)).repeat_interleave(counts)
        step = -(-len(points) // _MAX_RETURNS) or 1
        points = points[::step] @ _BOX_FROM_BODY + torch.tensor([0.0, height / 2, 0.0])
        at = walk.at(np.array([seconds for seconds, _ in self.returns]))
        joints = Seen(points, moments[::step], at, height).gait().joints(walk.at(self.seconds))[0]
        joints[:, 0] = quat.from_matrix(self.track.world_from_object[:, :3, :3] @ _BOX_FROM_BODY)
        return BodyPoses(joints.float(), torch.from_numpy(used), torch.zeros(10))


def _bodies(log: DrivingLog, tracks: Sequence[Track], held_out: frozenset[int]) -> list[BodyPoses]:
    rate = log.frame_rate or FRAME_RATE
    period = log.frame_periods / rate
    people = []
    for track in tracks:
        used = torch.tensor([frame not in held_out for frame in track.frames.tolist()])
        times = track.frames / (log.num_frames - 1 or 1) if track.times is None else track.times
        seen = {"frames": track.frames[used], "world_from_object": track.world_from_object[used]}
        trained = replace(track, **seen, times=None if track.times is None else track.times[used])
        people.append(_Person(track, trained, period * times.double().numpy()))
    for sweep in log.sweeps.where(lambda index: index not in held_out).gray():
        for person in people:
            person.look(sweep, period * sweep.time)
    unseen = sum(sum(len(points) for _, points in person.returns) < MIN_RETURNS for person in people)
    if people:
        said = "gaits of %d people are fitted to their returns; %d more have too few, and walk as usual"
        _log.info(said, len(people) - unseen, unseen)
    return [person.body(held_out) for person in people]
