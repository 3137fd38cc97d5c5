"""Colored points in the world: what lidar saw, and random guesses where it saw nothing."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.geometry.cameras import project
from sparsestreet.types import Frame

FARTHEST_RATIO = 0.02
"""Far points are drawn at radius / u with u from here to 1 (DriveStudio): out to 50 times the scene's radius."""

CANDIDATES_PER_POINT = 3
"""Random positions drawn at once for each one wanted, since most lie in no view (DriveStudio)."""

VIEWS_PER_ROUND = 24
"""Views that each draw is tested against, chosen anew: neighboring views see nearly the same space."""

ROUNDS = 10
"""Draws before a scene whose cameras see a small part of the space makes do with fewer points."""


@dataclass(frozen=True)
class Points:
    """Positions in meters and RGB in [0, 1]."""

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return self.positions.shape[0]

    def where(self, mask: Bool[Tensor, " n"]) -> "Points":
        return Points(self.positions[mask], self.colors[mask])

    def sampled(self, limit: int, generator: torch.Generator) -> "Points":
        """At most ``limit`` of the points, drawn without replacement."""
        if len(self) <= limit:
            return self
        chosen = torch.randperm(len(self), generator=generator)[:limit]
        return Points(self.positions[chosen], self.colors[chosen])

    @staticmethod
    def concatenate(parts: Sequence["Points"]) -> "Points":
        empty = torch.zeros(0, 3)
        return Points(
            torch.cat([empty, *(part.positions for part in parts)]),
            torch.cat([empty, *(part.colors for part in parts)]),
        )


def near_positions(
    count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """Uniform in the ball of ``radius`` meters about ``center``."""
    distance = radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    return center + distance * _directions(count, generator)


def far_positions(
    count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """In uniform directions at distance radius / u, u uniform: density falls with the distance."""
    u = FARTHEST_RATIO + (1 - FARTHEST_RATIO) * torch.rand(count, 1, generator=generator)
    return center + radius / u * _directions(count, generator)


def random_points(
    draw: Callable[[int, Tensor, float, torch.Generator], Tensor],
    count: int,
    center: Float[Tensor, "3"],
    radius: float,
    frames: Sequence[Frame],
    generator: torch.Generator,
) -> Points:
    """``count`` points of the distribution ``draw`` that the frames see; fewer if they see too little of it."""
    found = Points.concatenate([])
    for _ in range(ROUNDS):
        if len(found) >= count:
            break
        candidates = draw(CANDIDATES_PER_POINT * count, center, radius, generator)
        views = torch.randperm(len(frames), generator=generator)[:VIEWS_PER_ROUND].tolist()
        found = Points.concatenate([found, seen_points(candidates, (frames[view] for view in views))])
    return found.sampled(count, generator)


def seen_points(positions: Float[Tensor, "n 3"], frames: Iterable[Frame]) -> Points:
    """Those positions that the first view looking at them does not show as sky, with the color they have there.

    A ray that ends in the sky meets nothing, so a Gaussian on it could only learn to vanish. Without sky masks every
    position inside some view is kept.
    """
    kept, undecided = [], positions
    for frame in frames:
        pixels, _, inside = project(frame.camera, undecided)
        column, row = pixels[inside].long().unbind(1)
        seen = Points(undecided[inside], frame.image[row, column].float() / 255)
        kept.append(seen if frame.sky is None else seen.where(~frame.sky[row, column]))
        undecided = undecided[~inside]
    return Points.concatenate(kept)


def _directions(count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
