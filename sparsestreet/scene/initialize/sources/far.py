"""Guesses far away."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.initialize.sources.guesses import Guesses, directions

FARTHEST_RATIO = 0.02
"""Far points are drawn at radius / u with u from here to 1 (DriveStudio): out to 50 times the scene's radius."""


@dataclass(frozen=True, kw_only=True)
class FarPoints(Guesses):
    """Random points outside of the ball around the scene."""

    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """In uniform directions at distance radius / u, u uniform: density falls with the distance."""
        u = FARTHEST_RATIO + (1 - FARTHEST_RATIO) * torch.rand(count, 1, generator=generator)
        return center + radius / u * directions(count, generator)
