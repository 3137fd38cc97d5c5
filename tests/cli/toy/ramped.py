"""A weight of the masks that changes over the run: a loss derived from the one that masks need."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.training.losses import MaskSparsity
from sparsestreet.types import Frame


@dataclass(frozen=True)
class RampedSparsity(MaskSparsity):
    """lambda_n of every node rises from 0 to its own value over the first part of the run."""

    ramp: float = 0.5
    """Fraction of the run."""

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        share = min(1.0, rendering.state.progress / self.ramp)
        return share * MaskSparsity.__call__(self, rendering, frame, scene)
