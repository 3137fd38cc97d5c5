"""Finds the points that lie in objects' boxes."""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.geometry.boxes import box_at, inside_box
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.scene.initialize.points import Points
from sparsestreet.types import Sweep, Track


def returns_in_box_frame(track: Track, sweep: Sweep) -> Float[Tensor, "n 3"] | None:
    """Returns a sweep in the track's box frame at its time, meters; None if the track has no box in its frame."""
    world_from_object = box_at(track, sweep.index, sweep.time)
    return None if world_from_object is None else _in_frame(world_from_object, sweep.points)


def outside_boxes(tracks: Sequence[Track], sweep: Sweep, enlargement: float) -> Bool[Tensor, " n"]:
    """Returns whether the points of a sweep lie in none of the tracks' boxes at its time."""
    outside = torch.ones(sweep.points.shape[0], dtype=torch.bool)
    for track in tracks:
        in_box_frame = returns_in_box_frame(track, sweep)
        if in_box_frame is not None:
            outside &= ~inside_box(in_box_frame, track.size, enlargement)
    return outside


def outside_swept_boxes(
    tracks: Sequence[Track], points: Float[Tensor, "n 3"], held_out: frozenset[int] = frozenset()
) -> Bool[Tensor, " n"]:
    """Returns whether world points lie in none of the tracks' boxes at any frame, those held out left aside."""
    outside = torch.ones(points.shape[0], dtype=torch.bool)
    for track in tracks:
        centers = track.world_from_object[:, :3, 3].to(points.dtype)
        reach = track.size.norm() / 2
        # Few points lie near the path of an object; only these are taken to its boxes, of which there are many.
        near = ((points >= centers.amin(0) - reach) & (points <= centers.amax(0) + reach)).all(1).nonzero().flatten()
        for frame, world_from_object in zip(track.frames.tolist(), track.world_from_object, strict=True):
            if frame not in held_out:
                outside[near[inside_box(_in_frame(world_from_object, points[near]), track.size)]] = False
    return outside


def box_surface_points(count: int, size: Float[Tensor, "3"], generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Returns random points on the faces of a box about the origin, spread evenly over its area.

    >>> size = torch.tensor([4.0, 2.0, 1.5])
    >>> points = box_surface_points(10, size, torch.Generator().manual_seed(0))
    >>> bool(((2 * points.abs() / size).amax(1) == 1).all())
    True
    """
    length, width, height = size.tolist()
    areas = torch.tensor([width * height, length * height, length * width])
    axis = torch.multinomial(areas, count, replacement=True, generator=generator)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * size
    side = torch.where(torch.rand(count, generator=generator) < 0.5, -0.5, 0.5)
    points[torch.arange(count), axis] = side * size[axis]
    return points


def lidar_in_boxes(tracks: Sequence[Track], sweeps: Iterable[Sweep]) -> list[Points]:
    """Returns for each object the colored returns inside its box at their own instant, in the box frame.

    It passes once over the sweeps, which may be read from disk on the way.
    """
    parts: list[list[Points]] = [[] for _ in tracks]
    for sweep in sweeps:
        for track, found in zip(tracks, parts, strict=True):
            in_box_frame = returns_in_box_frame(track, sweep)
            if in_box_frame is not None:
                inside = inside_box(in_box_frame, track.size) & sweep.colored
                found.append(Points(in_box_frame, sweep.colors).where(inside))
    return [Points.concatenate(found) for found in parts]


def _in_frame(world_from_object: Float64[Tensor, "4 4"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return transform_points(inverse(world_from_object), points.double()).to(points.dtype)
