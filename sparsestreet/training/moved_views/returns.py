"""The returns of the training sweeps: those of the street, and those of moving objects in the frames of their boxes."""

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.geometry.boxes import CarriedPoints, box_at, inside_box
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.boxes import outside_boxes, returns_in_box_frame
from sparsestreet.scene.initialize.points import at_most
from sparsestreet.training.moved_views.coloring import agreement, seen_colors
from sparsestreet.training.moved_views.settings import MovedViews
from sparsestreet.training.moved_views.target import Box, Returns
from sparsestreet.types import Frame, Sweep, Track

ENLARGEMENT = 1.15
"""Of moving boxes, in which nothing belongs to the street."""
ROAD = 0.25
"""Meters above the floor of its box from which on a return belongs to the object and not to the road below it."""


@dataclass(frozen=True)
class StreetReturns:
    """What lidar says of the street at all training instants, and of its objects at each."""

    street: Returns
    """World, in the order of the sweeps."""
    frames: tuple[int, ...]
    """Integer frames of the sweeps."""
    starts: tuple[int, ...]
    """First row of each sweep in ``street``, and behind the last one the number of rows."""
    objects: Mapping[int, Returns]
    """Integer frame -> returns of this frame from objects of fixed shape, in the world, at the time of the sweep."""
    moving: tuple[Track, ...]
    """All objects that move."""
    carried: Mapping[int, CarriedPoints] = field(default_factory=dict)
    """Integer frame -> the points of ``objects``, which these carry to other times of the frame."""

    def around(self, frame: int, sweeps: int) -> slice:
        """Rows of the street from at most ``sweeps`` frames before or after."""
        first, behind = bisect_left(self.frames, frame - sweeps), bisect_right(self.frames, frame + sweeps)
        return slice(self.starts[first], self.starts[behind])

    def objects_at(self, frame: int, time: float) -> Returns:
        """From objects of fixed shape, in the world at a time of the frame."""
        found = self.objects.get(frame, Returns.concatenate([]))
        return replace(found, points=self.carried[frame].at(time)) if frame in self.carried else found

    def boxes(self, frame: int, time: float) -> list[Box]:
        """Of the moving objects at a time of a frame."""
        found = [(box_at(track, frame, time), track.size) for track in self.moving]
        return [(pose, size) for pose, size in found if pose is not None]

    def agreement(self) -> float:
        """Mean weight of the street's returns, in [0, 1]."""
        return float(self.street.weights.mean()) if len(self.street) else 1.0


def collect(
    sweeps: Sweeps,
    frames: Frames,
    moving: Sequence[Track],
    rigid: Sequence[Track],
    settings: MovedViews,
    seed: int,
) -> StreetReturns:
    """The returns of sweeps, in the colors of the images of their instants.

    Args:
        sweeps: of the training instants.
        frames: training views; their images color the returns.
        moving: objects that move; nothing in their boxes belongs to the street.
        rigid: those of them that keep their shape.
        settings: how many returns are kept, and how their weights fall.
        seed: of the choice of the returns that are kept.
    """
    places = _by_instant(frames)
    instants = sorted(places)

    # Sweeps come in order: each image is decoded once, and few are in memory.
    @lru_cache(maxsize=3)
    def images(instant: int) -> list[Frame]:
        return [frames[place] for place in places.get(instant, [])]

    generator = named_generator(seed, "moved views")
    street, starts, objects, carried = [], [0], {}, {}
    for sweep in sweeps:
        points = CarriedPoints(sweep.points, sweep.time, sweep.index, moving, ENLARGEMENT)
        shown = images(sweep.index)
        colors, seen = seen_colors(sweep.points, shown, [points.at(frame.time) for frame in shown])
        still = seen & outside_boxes(moving, sweep, ENLARGEMENT)
        rows = at_most(settings.returns_per_sweep, torch.nonzero(still).squeeze(-1), generator)
        others = [frame for near in _beside(sweep.index, instants) for frame in images(near)]
        weights = agreement(sweep.points[rows], colors[rows], others, settings.tolerance)
        street.append(Returns(sweep.points[rows], colors[rows], weights))
        starts.append(starts[-1] + len(rows))
        on = torch.nonzero(seen & _on_objects(sweep, rigid)).squeeze(-1)
        carried[sweep.index] = replace(points, points=sweep.points[on], tracks=rigid)
        objects[sweep.index] = Returns(carried[sweep.index].points, colors[on], torch.ones(len(on)))
    return StreetReturns(Returns.concatenate(street), sweeps.indices, tuple(starts), objects, tuple(moving), carried)


def _by_instant(frames: Frames) -> dict[int, list[int]]:
    """Integer frame -> places of its views; no pixel is read."""
    found = defaultdict(list)
    for place, view in enumerate(frames.views):
        found[view.indices[0]].append(place)
    return found


def _beside(frame: int, instants: Sequence[int]) -> list[int]:
    """The instants before and after a frame."""
    return [*instants[: bisect_left(instants, frame)][-1:], *instants[bisect_right(instants, frame) :][:1]]


def _on_objects(sweep: Sweep, rigid: Sequence[Track]) -> Tensor:
    on = torch.zeros(len(sweep.points), dtype=torch.bool)
    for track in rigid:
        local = returns_in_box_frame(track, sweep)
        if local is not None:
            on |= inside_box(local, track.size) & (local[:, 2] > ROAD - track.size[2] / 2)
    return on
