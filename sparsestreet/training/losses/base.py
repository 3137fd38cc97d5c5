"""What every loss term is: a weighted number from a rendering, the frame it should look like, and the scene."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@runtime_checkable
class Loss(Protocol):
    def applies(self, frame: Frame) -> bool:
        """Whether the frame carries what the term compares with."""
        ...

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        """The weighted term."""
        ...
