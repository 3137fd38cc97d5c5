"""Pixels are covered or they are not: the entropy of alpha, as DriveStudio's paper_legacy configurations have it."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class OpacityEntropy:
    """Mean over the pixels of -a log((a + eps) / (1 + eps)): 0 at both ends, with a finite slope at each.

    -a log a itself is infinitely steep where nothing is drawn. Raises ValueError for an ``eps`` that is not positive.
    """

    weight: float = 0.05
    eps: float = 1e-6

    def __post_init__(self) -> None:
        if not self.eps > 0:
            raise ValueError(f"the entropy has a finite slope at alpha 0 for eps > 0 only, got {self.eps}")

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        alpha = rendering.alpha
        return -self.weight * (alpha * ((alpha + self.eps) / (1 + self.eps)).log()).mean()
