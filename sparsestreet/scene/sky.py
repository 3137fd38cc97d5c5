"""The sky: a color for every direction, at infinity."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.ops.cube_map import colors_along
from sparsestreet.scene.learning_rate import LearningRate


@dataclass(frozen=True)
class SkySettings:
    """Size, start and learning rate of the sky's cube map."""

    resolution: int = 128
    initial_color: float = 0.5
    learning_rate: LearningRate = field(default_factory=lambda: LearningRate(0.01))


class Sky(nn.Module):
    """A cube map with bilinear interpolation, also across the edges of its faces; values are not bounded."""

    texels: Float[Tensor, "6 r r 3"]

    def __init__(self, settings: SkySettings = SkySettings()) -> None:
        super().__init__()
        if settings.resolution < 1:
            raise ValueError(f"a cube map needs at least one texel a side, got resolution {settings.resolution}")
        self.settings = settings
        side = settings.resolution
        self.texels = nn.Parameter(torch.full((6, side, side, 3), settings.initial_color))

    def colors(self, directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Color seen along world directions of any non-zero length; gradients go to the texels only."""
        return colors_along(self.texels, directions.reshape(-1, 3)).reshape(directions.shape)
