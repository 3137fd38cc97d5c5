"""Whether lidar returns keep their gray level from one image to the next, where the poses say that they are."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.geometry.cameras import project
from sparsestreet.types import Frame, View

PAIRS = 8
"""Of images of a camera that are compared."""
LEAST_STEP = 1.5
"""Meters between the two images of a pair. From one image to the next the color of a hood that nobody declares, or of
a few large pixels, outweighs the street's."""
FEWEST = 50
"""Returns of a pair; fewer say nothing."""
_MOVES = 2.0
"""Pixels within a pair, below which a return does not count: whoever stands is right anyway."""


def followed(frames: Frames, sweeps: Sweeps) -> dict[int, float | None]:
    """Camera index -> how much the gray level changes at returns that are followed, over that at their old pixels.

    Right poses make it smaller than 1. If the axes of a camera are swapped, returns move anywhere, and following them
    is worse than staying. The median over pairs of images; None where most show hardly any return. Cameras that stand
    are left out.
    """
    places, found = {index: place for place, index in enumerate(sweeps.indices)}, {}
    for camera in sorted({view.indices[1] for view in frames.views}):
        own = frames.where(lambda view, camera=camera: view.indices[1] == camera)
        pairs = [(a, b) for a, b in _pairs(own.views) if own.views[a].indices[0] in places]
        ratios, blind, looked = [], 0, spread(len(pairs), PAIRS) if pairs else []
        for first, second in (pairs[place] for place in looked):
            both = own[first], own[second]
            old, new = _seen(*both, sweeps[places[own.views[first].indices[0]]].points)
            blind += len(old) < FEWEST
            moving = (new - old).norm(dim=1) >= _MOVES
            if int(moving.sum()) >= FEWEST:
                ratios.append(_ratio(*both, old[moving], new[moving]))
        if 2 * blind > len(looked):
            found[camera] = None
        elif ratios:
            found[camera] = float(torch.tensor(ratios).median())
    return found


def _pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Places of each image and of the first behind it that is far enough away."""
    positions = torch.stack([view.camera.position for view in views])
    found = []
    for place in range(len(views) - 1):
        far = torch.nonzero((positions[place + 1 :] - positions[place]).norm(dim=1) >= LEAST_STEP)
        if len(far):
            found.append((place, place + 1 + int(far[0])))
    return found


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


def _places(pixels: Float[Tensor, "n 2"]) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    column, row = pixels.long().clamp(min=0).unbind(1)
    return row, column


def _ratio(first: Frame, second: Frame, old: Float[Tensor, "n 2"], new: Float[Tensor, "n 2"]) -> float:
    before, after = (frame.image.float().mean(-1) for frame in (first, second))
    after = after * (before.mean() / after.mean().clamp(min=1.0))  # exposure may change
    level = before[_places(old)]
    stayed = (after[_places(old)] - level).abs().mean()
    return float((after[_places(new)] - level).abs().mean() / stayed.clamp(min=0.5))
