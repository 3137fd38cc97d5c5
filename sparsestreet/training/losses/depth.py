"""Rendered depth against lidar: L1 over the pixels with a return."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class Depth:
    """The inverse depth bounds the pull of far and wrong returns (DriveStudio's paper_legacy configurations)."""

    weight: float = 0.1
    inverse: bool = True
    """False: the depth itself, in meters (its current configurations, with weight 0.01)."""
    nearest: float = 0.5
    farthest: float = 80.0
    """Returns outside [nearest, farthest] meters are left out."""
    nearest_rendered: float | None = None
    """Meters; pixels whose rendered depth is smaller are left out. None: ``nearest``."""

    def applies(self, frame: Frame) -> bool:
        return frame.depth is not None

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        assert frame.depth is not None  # it applies
        measured, rendered = frame.depth, rendering.depth
        least = self.nearest if self.nearest_rendered is None else self.nearest_rendered
        valid = (measured > self.nearest) & (measured < self.farthest) & (rendered > least)
        # Over all pixels, because picking the valid ones would wait for a device; 1 m stands where none is.
        rendered, measured = torch.where(valid, rendered, 1.0), torch.where(valid, measured, 1.0)
        error = 1 / rendered - 1 / measured if self.inverse else rendered - measured
        return self.weight * (error.abs().sum() / valid.sum().clamp(min=1))
