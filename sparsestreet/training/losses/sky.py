"""Gaussians stay out of the sky: binary cross entropy between alpha and the complement of the sky mask."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class SkyMask:
    """Mean over the pixels of a cross entropy that is finite, and pulls, at every alpha.

    With a = alpha, y = 0 in the sky and 1 elsewhere::

        -(y log((a + eps) / (1 + eps)) + (1 - y) log((1 - a + eps) / (1 + eps)))

    Its derivative is -1 / (a + eps) outside the sky and 1 / (1 - a + eps) in it: it never vanishes. Its magnitude grows
    from 1 / (1 + eps) where alpha is right to 1 / eps where it is most wrong, the value from 0 to log((1 + eps) / eps).
    Clamping alpha bounds both as well, but lets no gradient through where alpha is most wrong. With a ``floor`` f,
    DriveStudio's ``safe_bce``, the logarithms stop at log f, and the gradient stays 1 / f beyond: value and gradient
    are then those of two functions.

    Raises ValueError for an ``eps`` that is not positive, or a ``floor`` outside (0, 1).
    """

    weight: float = 0.05
    eps: float = 1e-3
    floor: float | None = None
    """DriveStudio's ``safe_bce``: 0.1. None: no floor."""

    def __post_init__(self) -> None:
        if not self.eps > 0:
            raise ValueError(f"the cross entropy of an alpha of 0 or 1 is finite for eps > 0 only, got {self.eps}")
        if self.floor is not None and not 0 < self.floor < 1:
            raise ValueError(f"the floor of a cross entropy lies between 0 and 1, got {self.floor}: null for none")

    def applies(self, frame: Frame) -> bool:
        return frame.sky is not None

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        assert frame.sky is not None  # it applies
        right = torch.where(frame.sky, 1 - rendering.alpha, rendering.alpha)
        if self.floor is not None:
            # The value of the clamped number with the gradient of the number itself.
            right = right + (self.floor - right.detach()).relu()
        return -self.weight * ((right + self.eps) / (1 + self.eps)).log().mean()
