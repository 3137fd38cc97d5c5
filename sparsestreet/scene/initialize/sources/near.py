"""Random points around the drive."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.initialize.sources.guesses import Guesses, directions


@dataclass(frozen=True, kw_only=True)
class NearPoints(Guesses):
    """Random points in the ball around the scene."""

    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Returns points that are uniform in the ball."""
        distance = radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
        return center + distance * directions(count, generator)
