"""Random points far away."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.initialize.sources.guesses import Guesses, directions

FARTHEST_RATIO = 0.02
"""Smallest u of far points, which are drawn at radius / u (DriveStudio): out to 50 times the scene's radius."""


@dataclass(frozen=True, kw_only=True)
class FarPoints(Guesses):
    """Random points outside the ball around the scene."""

    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Returns points in uniform directions at distance radius / u; density falls with distance.

        u is uniform in [FARTHEST_RATIO, 1]. If ``blind``, it is uniform in [0, 1] and clamped, as in DriveStudio.
        """
        u = torch.rand(count, 1, generator=generator)
        u = u.clamp(min=FARTHEST_RATIO) if self.blind else FARTHEST_RATIO + (1 - FARTHEST_RATIO) * u
        return center + radius / u * directions(count, generator)
