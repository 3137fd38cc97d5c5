"""Boxes of annotated objects at any time, and the points that move with them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.types import Track, View


def box_at(track: Track, frame: int, time: float) -> Float64[Tensor, "4 4"] | None:
    """Return world_from_box at a normalized time that belongs to an integer frame; None if the track lacks the frame.

    It lies on the line (rotations: the shorter arc) between the frame's box and the next one on the side of ``time``,
    or beyond the frame's box at constant velocity. A box of that very time is returned as it is, as is any box of a log
    without a clock.

    >>> poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    >>> poses[1, 0, 3] = 2.0
    >>> times = torch.tensor([0.0, 1.0], dtype=torch.float64)
    >>> car = Track("car", "car", torch.tensor([0, 1]), poses, torch.tensor([4.0, 2.0, 1.5]), times=times)
    >>> box_at(car, 0, 0.25)[0, 3]
    tensor(0.5000, dtype=torch.float64)
    """
    found = torch.nonzero(track.frames == frame).flatten()
    if not len(found):
        return None
    place = int(found[0])
    pose = track.world_from_object[place]
    if track.times is None or len(track.times) == 1 or float(track.times[place]) == time:
        return pose
    step = 1 if time > float(track.times[place]) else -1
    other = place + step if 0 <= place + step < len(track.times) else place - step
    towards = track.world_from_object[other]
    fraction = (time - track.times[place]) / (track.times[other] - track.times[place])
    between = pose.clone()
    turned = quat.slerp(quat.from_matrix(pose[:3, :3]), quat.from_matrix(towards[:3, :3]), fraction)
    between[:3, :3] = quat.to_matrix(turned)
    between[:3, 3] = torch.lerp(pose[:3, 3], towards[:3, 3], fraction)
    return between


def view_lag(tracks: Sequence[Track], views: Sequence[View]) -> float:
    """Return the largest normalized time between a view and a box of its frame; 0 in a log without a clock.

    >>> from sparsestreet.types import Camera
    >>> camera = Camera(torch.eye(4), torch.eye(3), width=8, height=6)
    >>> times = torch.tensor([0.5], dtype=torch.float64)
    >>> pose = torch.eye(4, dtype=torch.float64)[None]
    >>> car = Track("car", "car", torch.tensor([1]), pose, torch.ones(3), times=times)
    >>> view_lag([car], [View(camera, 0.0, 0, 0), View(camera, 0.75, 1, 0)])
    0.25
    """
    frames = torch.tensor([view.indices[0] for view in views])
    times = torch.tensor([view.time for view in views], dtype=torch.float64)
    largest = 0.0
    for track in tracks:
        if track.times is not None:
            place = torch.searchsorted(track.frames, frames).clamp(max=len(track.frames) - 1)
            lags = torch.where(track.frames[place] == frames, (times - track.times[place]).abs(), 0.0)
            largest = max(largest, float(lags.max()))
    return largest


def inside_box(
    points_in_box: Float[Tensor, "n 3"], size: Float[Tensor, "3"], enlargement: float = 1.0
) -> Bool[Tensor, " n"]:
    """Return whether points of the box frame lie in the box, whose sides are multiplied by ``enlargement``.

    >>> inside_box(torch.tensor([[1.9, 0.0, 0.0], [2.1, 0.0, 0.0]]), torch.tensor([4.0, 2.0, 1.5])).tolist()
    [True, False]
    """
    return (points_in_box.abs() <= 0.5 * enlargement * size).all(1)


def crossings(
    start: Float[Tensor, "*#n 3"], steps: Float[Tensor, "n 3"], size: Float[Tensor, "3"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Return s where the lines start + s steps enter a box around the origin, and where they leave it.

    By the slabs of Kay and Kajiya (1986). A line that misses the box leaves before it enters.

    >>> start, steps = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0]])
    >>> crossings(start - 3, steps + 3, torch.tensor([4.0, 2.0, 2.0]))
    (tensor([0.6667, 0.6667]), tensor([0.8000, 0.8333]))
    """
    steps = torch.where(steps.abs() < 1e-6, 1e-6, steps)
    sides = ((-0.5 * size - start) / steps, (0.5 * size - start) / steps)
    return torch.minimum(*sides).amax(1), torch.maximum(*sides).amin(1)


def through_box(
    camera_from_box: Float64[Tensor, "4 4"], rays: Float64[Tensor, "n 3"], size: Float[Tensor, "3"]
) -> Bool[Tensor, " n"]:
    """Return whether rays from a camera, in its frame, meet a box ahead of it.

    >>> camera_from_box = torch.eye(4, dtype=torch.float64)
    >>> camera_from_box[2, 3] = 5.0
    >>> rays = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    >>> through_box(camera_from_box, rays, torch.tensor([2.0, 2.0, 2.0])).tolist()
    [True, False, False]
    """
    box_from_camera = inverse(camera_from_box)
    enters, leaves = crossings(box_from_camera[:3, 3], rays @ box_from_camera[:3, :3].T, size.double())
    return (enters <= leaves) & (leaves > 0)


def without_frames(tracks: Sequence[Track], frames: frozenset[int]) -> tuple[Track, ...]:
    """Return the tracks without their boxes of some frames, such as held-out ones; a track of no other is left out.

    A box between two others (``box_at``) then depends on none of these frames. Without a clock there are no boxes
    between others, and the tracks are returned as they are.

    >>> times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    >>> poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    >>> car = Track("car", "car", torch.tensor([0, 1, 2]), poses, torch.ones(3), times=times)
    >>> [track.frames.tolist() for track in without_frames([car], frozenset({1}))]
    [[0, 2]]
    """
    kept = [_without_frames(track, frames) for track in tracks]
    return tuple(track for track in kept if track is not None)


def _without_frames(track: Track, frames: frozenset[int]) -> Track | None:
    if track.times is None:
        return track
    left = torch.tensor([int(frame) not in frames for frame in track.frames])
    if not left.any():
        return None
    body = track.body
    if body is not None:
        body = replace(body, rotations=body.rotations[left], valid=body.valid[left])
    poses, times = track.world_from_object[left], track.times[left]
    return replace(track, frames=track.frames[left], world_from_object=poses, times=times, body=body)


@dataclass(frozen=True)
class CarriedPoints:
    """Points of one instant, some of which lie in boxes and move with these."""

    points: Float[Tensor, "n 3"]
    """World, meters, at ``time``."""
    time: float
    """Normalized time at which the points were measured."""
    frame: int
    """Integer frame that they belong to."""
    tracks: Sequence[Track]
    """Objects that may carry some of them."""
    enlargement: float = 1.1
    """Factor on the sides of boxes, because points may lie just outside an imprecise box."""

    def at(self, time: float) -> Float[Tensor, "n 3"]:
        """Return the points where they are at another time of the frame; at their own time this costs nothing."""
        if time == self.time or not self.riders:
            return self.points
        moved = self.points.clone()
        for track, rows, in_box in self.riders:
            world_from_box = box_at(track, self.frame, time)
            if world_from_box is not None:
                moved[rows] = transform_points(world_from_box, in_box).to(moved.dtype)
        return moved

    @cached_property
    def riders(self) -> list[tuple[Track, Int[Tensor, " k"], Float64[Tensor, "k 3"]]]:
        """Each track that carries points: their rows, and where they are in its box."""
        found = []
        for track in self.tracks:
            world_from_box = box_at(track, self.frame, self.time)
            if world_from_box is None:
                continue
            reach = 0.5 * self.enlargement * track.size.norm()
            # Few points lie near an object; only these are taken to its box.
            near = ((self.points - world_from_box[:3, 3].to(self.points)).abs() <= reach).all(1).nonzero().squeeze(1)
            in_box = transform_points(inverse(world_from_box), self.points[near].double())
            inside = inside_box(in_box, track.size, self.enlargement)
            if inside.any():
                found.append((track, near[inside], in_box[inside]))
        return found


_CHANCE = 0.05
"""Probability that errors alone pass for a displacement; the medians of three make it smaller."""

_DEVIATION_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute value."""


def displacement(track: Track) -> float:
    """Return the largest distance between two centers of the track's boxes, meters; 0 if noise explains it.

    Unlike ``Track.path_length`` it does not add up the errors of many boxes, and a car that comes back has moved.
    Running medians of three (Tukey 1977, with his rule for the ends) come first, so a single stray box counts for
    nothing. With f boxes and noise s the distance must exceed 2 s sqrt(2 ln(2 f / p)): of f normal errors none reaches
    half of it, with a probability of 1 - p. Two boxes show no noise, and their distance is taken as it is.

    >>> def boxes(*x: float) -> Track:
    ...     poses = torch.eye(4, dtype=torch.float64).repeat(len(x), 1, 1)
    ...     poses[:, 0, 3] = torch.tensor(x)
    ...     return Track("car", "Car", torch.arange(len(x)), poses, torch.tensor([4.0, 2.0, 1.5]))
    >>> displacement(boxes(0.0, 1.0, 2.0, 3.0)), displacement(boxes(0.0, 0.0, 9.0, 0.0, 0.0))
    (3.0, 0.0)
    """
    centers = track.world_from_object[:, :3, 3]
    if len(centers) < 2:
        return 0.0
    farthest = float(torch.pdist(_without_strays(centers)).max())
    explained = 2 * position_noise(track) * math.sqrt(2 * math.log(2 * len(centers) / _CHANCE))
    return farthest if farthest > explained else 0.0


def position_noise(track: Track) -> float:
    """Return the standard deviation of the box centers about a smooth path, meters, over the three axes together.

    Each center is compared with the straight line between those before and after, at its time. The median of these
    second differences leaves out strays. Without three boxes it is 0.

    >>> poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    >>> poses[:, 0, 3] = torch.tensor([0.0, 0.1, 0.0, 0.1])
    >>> trembling = Track("car", "Car", torch.arange(4), poses, torch.tensor([4.0, 2.0, 1.5]))
    >>> round(position_noise(trembling), 3)  # 0.1 beside each line, over sqrt(1.5), times 1.4826
    0.121
    """
    centers = track.world_from_object[:, :3, 3]
    times = track.frames.double() if track.times is None else track.times
    if len(centers) < 3:
        return 0.0
    after = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    beside = centers[1:-1] - (1 - after) * centers[:-2] - after * centers[2:]
    # Of three independent errors, with these weights.
    errors = beside / (1 + (1 - after).square() + after.square()).sqrt()
    return float((_DEVIATION_OF_MEDIAN * errors.abs().quantile(0.5, dim=0)).norm())


def _without_strays(centers: Float64[Tensor, "f 3"]) -> Float64[Tensor, "f 3"]:
    """Return running medians of three; an end is the median of itself, its neighbor and the line through the next."""
    if len(centers) < 4:
        return centers
    inner = _median(centers[:-2], centers[1:-1], centers[2:])
    first = _median(centers[0], inner[0], 3 * inner[0] - 2 * inner[1])
    last = _median(centers[-1], inner[-1], 3 * inner[-1] - 2 * inner[-2])
    return torch.cat((first[None], inner, last[None]))


def _median(*three: Tensor) -> Tensor:
    return torch.stack(three).median(dim=0).values
