"""The paper's masking loss: (lambda_m / K) sum over nodes of lambda_n sum of sigma(m_k)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class MaskSparsity:
    """K counts all Gaussians of all nodes, masked nodes or not; lambda_n is the ``sparsity_weight`` of the node's own
    mask."""

    weight: float = 1.0
    """lambda_m."""

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame, scene: SceneGraph) -> Float[Tensor, ""]:
        rows = max(sum(scene.counts().values()), 1)
        total = torch.zeros((), device=rendering.rgb.device)
        for name, node in scene.nodes.items():
            if node.mask is not None and node.mask.columns:
                visible = rendering.splats.visible[rendering.spans[name]]
                total = total + node.mask.sparsity_weight * node.mask.sparsity(node.rows, frame.time, visible)
        return self.weight * total / rows
