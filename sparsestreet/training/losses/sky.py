"""Gaussians stay out of the sky: binary cross entropy between alpha and the complement of the sky mask."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class SkyMask:
    weight: float = 0.05
    margin: float = 1e-3
    """Alpha is clamped to [margin, 1 - margin]: the cross entropy of an exact 0 or 1 is infinite."""

    def applies(self, frame: Frame) -> bool:
        return frame.sky is not None

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        alpha = rendering.alpha.clamp(self.margin, 1 - self.margin)
        occupied = torch.logical_not(frame.sky).to(alpha.dtype)
        return self.weight * binary_cross_entropy(alpha, occupied)
