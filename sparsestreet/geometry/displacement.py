"""How far an annotated object gets, told apart from the noise of its boxes."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.types import Track

_CHANCE = 0.05
"""Probability that errors alone pass for a displacement; the medians of three make it smaller."""

_DEVIATION_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute value."""


def displacement(track: Track) -> float:
    """Returns the largest distance between two centers of the track's boxes, meters; 0 if noise explains it.

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
    """Returns the standard deviation of the box centers about a smooth path, meters, over the three axes together.

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
    """Returns running medians of three; an end is the median of itself, its neighbor and the line through the next."""
    if len(centers) < 4:
        return centers
    inner = _median(centers[:-2], centers[1:-1], centers[2:])
    first = _median(centers[0], inner[0], 3 * inner[0] - 2 * inner[1])
    last = _median(centers[-1], inner[-1], 3 * inner[-1] - 2 * inner[-2])
    return torch.cat((first[None], inner, last[None]))


def _median(*three: Tensor) -> Tensor:
    return torch.stack(three).median(dim=0).values
