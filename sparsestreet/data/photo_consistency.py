"""Whether lidar returns keep their gray level from one image to the next, where the poses say that they are."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.geometry.boxes import box_at, inside_box
from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.types import Frame, Sweep, Track, View

Pixels = tuple[Int[Tensor, " n"], Int[Tensor, " n"]]
PAIRS = 8
"""Of images of a camera that are compared."""
MIN_STEP = 1.5
"""Meters between the two images of a pair. From one image to the next the color of a hood that nobody declares, or of
a few large pixels, outweighs the street's."""
FEWEST = 50
"""Returns of a pair; fewer say nothing."""
_LARGER = 1.2
"""Sides of boxes, whose objects move on their own."""
_MOVES = 2.0
"""Pixels within a pair, below which a return does not count: whoever stands is right anyway."""


@dataclass(frozen=True)
class ReturnPairs:
    """Returns that two images of a camera show, and how their gray level changes."""

    old: Pixels
    """Row and column in the first image."""
    new: Pixels
    """In the second, as the poses have it."""
    stayed: Float[Tensor, " n"]
    """Change of the gray level at the old pixel, of 255; exposure left out."""
    moved: Float[Tensor, " n"]
    """From the old pixel to the new one."""
    enough: bool
    """Whether both images show as many returns as it takes to say something, moving ones or not."""


def return_pairs(own: Frames, sweeps: Sweeps, tracks: Sequence[Track]) -> Iterator[ReturnPairs]:
    """Of pairs of a camera's images, spread over the drive: the returns that move by some pixels. Those in boxes are
    left out."""
    places = {index: place for place, index in enumerate(sweeps.indices)}
    pairs = [(a, b) for a, b in _pairs(own.views) if own.views[a].indices[0] in places]
    for a, b in (pairs[place] for place in (spread(len(pairs), PAIRS) if pairs else ())):
        first, second = own[a], own[b]
        old, new = _seen(first, second, _standing(sweeps[places[first.indices[0]]], tracks))
        moving = (new - old).norm(dim=1) >= _MOVES
        before, after = (frame.image.float().mean(-1) for frame in (first, second))
        after = after * (before.mean() / after.mean().clamp(min=1.0))
        here, there = _places(old[moving]), _places(new[moving])
        level = before[here]
        yield ReturnPairs(here, there, (after[here] - level).abs(), (after[there] - level).abs(), len(old) >= FEWEST)


def gray_changes(frames: Frames, sweeps: Sweeps, tracks: Sequence[Track]) -> dict[int, float | None]:
    """Camera index -> how much the gray level changes at returns that are followed, over that at their old pixels.

    Right poses make it smaller than 1. If the axes of a camera are swapped, returns move anywhere, and following them
    is worse than staying. The median over pairs of images; None where most show hardly any return. Cameras that stand
    are left out.
    """
    found = {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        returns = list(return_pairs(own, sweeps, tracks))
        ratios = [
            float(each.moved.mean() / each.stayed.mean().clamp(min=0.5))
            for each in returns
            if len(each.moved) >= FEWEST
        ]
        if 2 * sum(not each.enough for each in returns) > len(returns):
            found[camera] = None
        elif ratios:
            found[camera] = float(torch.tensor(ratios).median())
    return found


def _pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Places of each image and of the first behind it that is far enough away."""
    positions = torch.stack([view.camera.position for view in views])
    found = []
    for place in range(len(views) - 1):
        far = torch.nonzero((positions[place + 1 :] - positions[place]).norm(dim=1) >= MIN_STEP)
        if len(far):
            found.append((place, place + 1 + int(far[0])))
    return found


def _standing(sweep: Sweep, tracks: Sequence[Track]) -> Float[Tensor, "n 3"]:
    """The sweep's points outside of all boxes."""
    points = sweep.points
    for track in tracks:
        world_from_box = box_at(track, sweep.index, sweep.time)
        if world_from_box is not None:
            in_box = transform_points(inverse(world_from_box), points.double()).to(points.dtype)
            points = points[~inside_box(in_box, track.size, _LARGER)]
    return points


def _seen(
    first: Frame, second: Frame, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "m 2"]]:
    """Pixels, in both images, of the returns that both see; those of the recording car left out."""
    here, _, seen = project(first.camera, points)
    there, _, still_seen = project(second.camera, points)
    both = seen & still_seen
    here, there = here[both], there[both]
    if first.ego is None:
        return here, there
    street = ~first.ego[_places(here)]
    return here[street], there[street]


def _places(pixels: Float[Tensor, "n 2"]) -> Pixels:
    column, row = pixels.long().clamp(min=0).unbind(1)
    return row, column
