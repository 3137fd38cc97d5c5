"""Inverse depth is smooth where the recorded image is (Godard et al. 2017, as in DriveStudio's paper_legacy)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame

NEAREST = 1e-5
"""Meters added to a depth before it is inverted."""


@dataclass(frozen=True)
class InverseDepthSmoothness:
    """mean(|dx d| exp(-|dx I|)) + mean(|dy d| exp(-|dy I|)) of the inverse depth d; |I| is the mean of the channels.

    Steps between neighbors of which one shows nothing (depth 0) count as none: an inverse depth of 10^5 would stand
    there. ``kornia.losses.inverse_depth_smoothness_loss``, the oracle of the tests, is the same elsewhere.
    """

    weight: float = 0.001

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        truth = frame.image.to(rendering.depth.dtype) / 255
        inverse, drawn = 1 / (rendering.depth + NEAREST), rendering.depth > 0
        terms = []
        for axis in (0, 1):
            steps = inverse.diff(dim=axis).abs() * torch.exp(-truth.diff(dim=axis).abs().mean(-1))
            alike = drawn.narrow(axis, 1, steps.shape[axis]) & drawn.narrow(axis, 0, steps.shape[axis])
            terms.append(torch.where(alike, steps, 0.0).mean())
        return self.weight * (terms[0] + terms[1])
