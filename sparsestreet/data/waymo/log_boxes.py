"""The boxes of a log as labels: each at an instant that the layout can tell, carried there along its track.

A file has no instants of boxes. They follow from where a box is: when the beam crosses it, or when the camera that it
names reads its column (``boxes.read_boxes``). The one nearest to the log's own instant is taken.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.roles import role_of
from sparsestreet.data.waymo.boxes import reading
from sparsestreet.data.waymo.images import middle, readout
from sparsestreet.data.waymo.lidar import SPIN, crossing
from sparsestreet.data.waymo.log_segment import LogSegment
from sparsestreet.data.waymo.segment import CLASSES, BoxLabel, ImageMotion
from sparsestreet.geometry.boxes import box_at
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import Track

KINDS = {"vehicle": 1, "pedestrian": 2, "cyclist": 4}
"""Role -> number of Waymo's class. Others have none: their boxes are not written."""
_ROUNDS = 4
"""Each shrinks the error of an instant by the box's angular speed over the sensor's, a hundredth at most."""


_CLOCK = 1000
"""Nanoseconds: what the rounding of stamps alone can make."""


def class_name(own: str) -> str:
    """Waymo's name of a class; those that it lacks keep their own.

    >>> class_name("rider"), class_name("Misc")
    ('Cyclist', 'Misc')
    """
    return CLASSES[KINDS[role]] if (role := role_of(own)) in KINDS else own


@dataclass(frozen=True)
class _Written:
    label: BoxLabel
    stamp: int
    """Nanoseconds at which a reader takes the box to be there."""
    carried: int
    """Nanoseconds from the box's own instant to that one."""
    lean: float
    """Radians between the box's upright and the vehicle's, which is its own in the file."""


@dataclass(frozen=True)
class LogBoxes:
    """All labels of a log, worked out when the first is asked for: they are small."""

    segment: LogSegment

    def labels(self, frame: int) -> list[BoxLabel]:
        return [one.label for one in self._written[0][frame]]

    def losses(self) -> Iterator[str]:
        log, (frames, dropped) = self.segment.log, self._written
        written = [one for some in frames.values() for one in some]
        others = [track.class_name for track in log.tracks if role_of(track.class_name) not in KINDS]
        if others:
            names = ", ".join(sorted(set(others)))
            yield f"{len(others)} objects of {names} are left out: Waymo has vehicles, pedestrians and cyclists alone"
        carried = [abs(one.carried) for one in written if abs(one.carried) > _CLOCK]
        if carried:
            yield (
                f"{len(carried)} of {len(written)} boxes are carried along their tracks to another instant, by up to "
                f"{max(carried) / 1e6:.3g} ms: the layout tells no instants of boxes"
            )
        if dropped:
            yield f"{dropped} boxes are left out: at no instant that the layout can tell do they follow the one before"
        lean = max((one.lean for one in written), default=0.0)
        if lean > 1e-4:
            yield f"boxes lean by up to {np.degrees(lean):.2g} degrees from the vehicle's upright: that is lost"

    @cached_property
    def _written(self) -> tuple[dict[int, list[_Written]], int]:
        """By frame; and how many found no place."""
        segment = self.segment
        found: dict[int, list[_Written]] = {frame: [] for frame in range(segment.log.num_frames)}
        last: dict[str, int] = {}
        tracks = [segment.times.timed(track, segment.log.num_frames) for track in segment.log.tracks]
        tracks = [track for track in tracks if role_of(track.class_name) in KINDS]
        dropped = 0
        for frame in found:
            motions = {name: segment.motion(name, view) for name, view in segment.views(frame).items()}
            world_from_vehicle = segment.world_from_vehicle(frame)
            for track in tracks:
                if not (track.frames == frame).any():
                    continue
                one = self._place(track, frame, world_from_vehicle, motions, last.get(track.name))
                dropped += one is None
                if one is not None:
                    last[track.name] = one.stamp
                    found[frame].append(one)
        return found, dropped

    def _place(
        self,
        track: Track,
        frame: int,
        world_from_vehicle: Float64[Tensor, "4 4"],
        motions: Mapping[str, ImageMotion],
        last: int | None,
    ) -> _Written | None:
        segment, place = self.segment, int(torch.nonzero(track.frames == frame)[0])
        assert track.times is not None  # as LogTimes.timed gives them
        own = segment.times.stamp(float(track.times[place]))

        vehicle_from_log = inverse(world_from_vehicle) @ segment.log.dataset_from_world

        def box(stamp: int) -> Float64[Tensor, "4 4"]:
            pose = box_at(track, frame, segment.times.time(stamp))
            assert pose is not None  # it has the frame
            return vehicle_from_log @ pose

        def crossed(stamp: int) -> int:
            x, y = box(stamp)[:2, 3].tolist()
            return 1000 * segment.stamps[frame] + crossing(x, y)

        def seen(name: str, stamp: int) -> int:
            return reading(motions[name], segment.cameras[name], (world_from_vehicle @ box(stamp))[:3, 3].numpy())

        beam = _settled(crossed, 1000 * segment.stamps[frame] + SPIN // 2)
        by, best = None, beam if last is None or beam > last else None
        # The nearest camera first: one that reads its image farther away than what was found is not looked at.
        for name in sorted(motions, key=lambda name: abs(middle(motions[name]) - own)):
            about, reach = middle(motions[name]), readout(motions[name]) // 2
            if best is None or abs(about - own) - reach < abs(best - own):
                stamp = _settled(lambda stamp, name=name: seen(name, stamp), about)
                if (best is None or abs(stamp - own) < abs(best - own)) and (last is None or stamp > last):
                    by, best = name, stamp
        if best is None:
            return None
        size = track.size.tolist()
        label = BoxLabel(
            track.name,
            KINDS[role_of(track.class_name)],
            _numbers(box(beam), size),
            None if by is None else _numbers(box(best), size),
            by,
        )
        lean = float(np.arccos(min(float(box(best)[2, 2]), 1.0)))
        return _Written(label, best, best - own, lean)


def _settled(at: Callable[[int], int], stamp: int) -> int:
    """Where the box is at the instant that follows from where it is."""
    for _ in range(_ROUNDS):
        before, stamp = stamp, at(stamp)
        if stamp == before:
            break
    return stamp


def _numbers(pose: Float64[Tensor, "4 4"], size: list[float]) -> tuple[float, ...]:
    """Center, length, width, height, heading."""
    return (*pose[:3, 3].tolist(), *size, float(torch.atan2(pose[1, 0], pose[0, 0])))
