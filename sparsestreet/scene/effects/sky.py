"""The sky: a color for every direction, at infinity."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.evidence.light import sky_share
from sparsestreet.ops import over_sky
from sparsestreet.ops.cube_map import colors_along
from sparsestreet.pictures.images import Marked
from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import LearningRate, Rates
from sparsestreet.scene.state import RenderOptions
from sparsestreet.types import Rendering, View

_NS_PER_PIXEL = 4.8
"""Where light gets through a fourth of the pixels, as in trained streets (docs/effects.md)."""


@dataclass(frozen=True, kw_only=True)
class SkySettings(EffectSettings):
    """Size, start and learning rate of the sky's cube map. Raises ValueError for a cube map without a texel."""

    resolution: int = 64
    initial_color: float = 0.5
    min_share: float = 0.005
    """Of the pixels, from which the log calls for it: what a tunnel lacks."""
    learning_rates: Rates = field(default_factory=lambda: {"texels": LearningRate(0.01)})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.resolution < 1:
            raise ValueError(f"a cube map needs at least one texel a side, got resolution {self.resolution}")

    def detect(self, data: TrainingData) -> Finding:
        found = sky_share(data.frames)
        if found is None:
            return Finding(
                called_for=True,
                reason=f"{data.log.name} has no sky masks that would say otherwise, and streets lie under the sky",
                unit="of the pixels",
                threshold=self.min_share,
            )
        return Finding(
            called_for=found.share >= self.min_share,
            reason=f"masks of {found.frames} images show sky in {100 * found.share:.1f} % of their pixels",
            value=found.share,
            unit="of the pixels",
            threshold=self.min_share,
            noise=found.error,
            evidence=partial(_shown, data),
        )

    def cost(self, data: TrainingData) -> Cost:
        return Cost(numbers=18 * self.resolution**2, ns_per_pixel=_NS_PER_PIXEL, ms_per_frame=0.14)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Sky":
        return Sky(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Sky":
        found, wanted = tuple(tensors["texels"].shape), (6, self.resolution, self.resolution, 3)
        if found != wanted:  # before a damaged resolution allocates what no machine has
            raise ValueError(f"the sky has texels of shape {found}, its settings say {wanted}: write the file again")
        return Sky(self)


def _shown(data: TrainingData) -> list[Marked]:
    """The sky of the first image that has a mask."""
    frame, mask = next((frame, frame.sky) for frame in data.frames if frame.sky is not None)
    index, camera = frame.indices
    return [Marked(f"sky of frame {index}, camera {camera}", frame.image.numpy(), mask.numpy())]


class Sky(Effect):
    """A cube map with bilinear interpolation, also across the edges of its faces; values are not bounded."""

    settings: SkySettings
    texels: Float[Tensor, "6 r r 3"]

    def __init__(self, settings: SkySettings = SkySettings()) -> None:
        super().__init__(settings)
        side = settings.resolution
        self.texels = nn.Parameter(torch.full((6, side, side, 3), settings.initial_color))

    def colors(self, directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Color seen along world directions of any non-zero length; gradients go to the texels only."""
        return colors_along(self.texels, directions.reshape(-1, 3)).reshape(directions.shape)

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        """Sky behind the splats where more light gets through than at which the op stops a pixel, by its backend."""
        backend = "torch" if options.backend == "reference" else options.backend
        limit = options.settings.transmittance_min
        return over_sky(rgb, splats.alpha, self.texels, view.camera, transmittance_min=limit, backend=backend)

    def background(self, view: View) -> Float[Tensor, "h w 3"]:
        shape = (view.camera.height, view.camera.width)
        rgb, alpha = self.texels.new_zeros(*shape, 3), self.texels.new_zeros(shape)
        return over_sky(rgb, alpha, self.texels, view.camera, transmittance_min=0.0)
