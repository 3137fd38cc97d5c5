"""One affine map of colors for all images: x -> A x + b, behind all other effects."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.scene.effects.effect import Cost, Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.learning_rate import LearningRate, Rates
from sparsestreet.scene.options import RenderOptions
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Rendering, View


@dataclass(frozen=True, kw_only=True)
class AffineSettings(EffectSettings):
    """Weights of the map's regularizers and its rate, off unless asked for.

    No log calls for it: a map that all images share changes nothing that the colors of the Gaussians could not be. It
    is the affine module of DriveStudio (e59bda4) as it acts. That means a map for each image by a network, which starts
    with all weights and inputs at zero. So the gradient of every weight and input stays zero, and only the last bias
    learns. Raises ValueError for a negative weight.
    """

    when: Literal["auto", "on", "off"] = "off"
    weight: float = 1e-5
    """Of mean |A - I| + mean |b|."""
    decay: float = 1e-6
    """Of half the squared numbers of A - I and b: Adam's weight decay of this rate, which is a term of the loss."""
    learning_rates: Rates = field(default_factory=lambda: {"deltas": LearningRate(1e-5)})
    found_when_off: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("weight", "decay"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be >= 0, got {getattr(self, name)}: 0 leaves the term out")

    def detect(self, data: TrainingData) -> Finding:
        return Finding(called_for=False, reason="one map of colors for all images is nothing that a log calls for")

    def cost(self, data: TrainingData) -> Cost:
        return Cost(numbers=12, ns_per_pixel=4.8, ms_per_frame=0.12)

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Affine":
        return Affine(self)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Affine":
        return Affine(self)


class Affine(Effect):
    """The map, whose ``deltas`` [3, 4] are A - I and b; it starts as the identity."""

    settings: AffineSettings

    def __init__(self, settings: AffineSettings = AffineSettings()) -> None:
        super().__init__(settings)
        self.deltas = nn.Parameter(torch.zeros(3, 4))

    def matrix(self) -> Float[Tensor, "3 3"]:
        """Returns A."""
        return self.deltas[:, :3] + torch.eye(3, dtype=self.deltas.dtype, device=self.deltas.device)

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        return rgb @ self.matrix().T + self.deltas[:, 3]

    def slope(self, view: View) -> Float[Tensor, "h w"]:
        """Root of the mean squared singular value of A, which maps a change of color to one of that length on average.

        For every single change if A turns colors and scales them alike; else it is off by A's largest (or smallest)
        singular value over this.
        """
        return (self.matrix().norm() / 3**0.5).expand(view.camera.height, view.camera.width)

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        """Returns ``identity`` and ``decay``, those that have a weight."""
        settings, terms = self.settings, {}
        if settings.weight > 0:
            terms["identity"] = settings.weight * (self.deltas[:, :3].abs().mean() + self.deltas[:, 3].abs().mean())
        if settings.decay > 0:
            terms["decay"] = settings.decay / 2 * self.deltas.square().sum()
        return terms
