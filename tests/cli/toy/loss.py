"""A loss of one's own: a frozen dataclass with two methods."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class MeanColor:
    """As a whole the rendered image has the color of the recorded one."""

    weight: float = 0.1

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        truth = frame.image.to(rendering.rgb) / 255
        return self.weight * (rendering.rgb.mean((0, 1)) - truth.mean((0, 1))).abs().mean()
