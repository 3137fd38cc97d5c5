"""An effect of one's own: settings that say when a log calls for it, and what it does to an image."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.scene.effects import Effect, EffectSettings, Finding
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.state import RenderOptions, SceneState
from sparsestreet.types import Rendering, View


@dataclass(frozen=True, kw_only=True)
class GainSettings(EffectSettings):
    """Called for where several cameras see one street."""

    evenness: float
    """Weight of the regularizer."""

    def detect(self, data: TrainingData) -> Finding:
        count = data.log.num_cameras
        return Finding(
            called_for=count >= 2,
            reason=f"{data.log.name} is seen by cameras with exposures of their own",
            value=float(count),
            unit="cameras",
            threshold=2.0,
        )

    def build(self, data: TrainingData, finding: Finding, generator: torch.Generator) -> "Gain":
        return Gain(self, data.log.num_cameras)

    def restore(self, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Gain":
        return Gain(self, header["cameras"])


class Gain(Effect):
    """Each camera multiplies the light by a factor of its own; a camera beside the log has their geometric mean."""

    settings: GainSettings

    def __init__(self, settings: GainSettings, cameras: int) -> None:
        super().__init__(settings)
        self.log_gains = nn.Parameter(torch.zeros(cameras))

    def gain(self, view: View) -> Float[Tensor, ""]:
        gains = self.log_gains
        return (gains.mean() if view.camera_index is None else gains[view.camera_index]).exp()

    def image(
        self, rgb: Float[Tensor, "h w 3"], splats: Rendering, view: View, options: RenderOptions
    ) -> Float[Tensor, "h w 3"]:
        return self.gain(view) * rgb

    def slope(self, view: View) -> Float[Tensor, "h w"]:
        return self.gain(view).expand(view.camera.height, view.camera.width)

    def regularizers(self, view: View, state: SceneState) -> dict[str, Float[Tensor, ""]]:
        # Twice the gains with half the light are the same images.
        return {"evenness": self.settings.evenness * self.log_gains.mean().square()}

    def header(self) -> dict[str, Any]:
        return {"cameras": len(self.log_gains)}
