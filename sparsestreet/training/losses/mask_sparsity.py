"""The paper's masking loss: (lambda_m / K) sum over nodes of lambda_n sum of sigma(m_k)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.rendering import SceneRendering
from sparsestreet.types import Frame


@dataclass(frozen=True)
class MaskSparsity:
    """K counts all rows of all nodes, masked nodes or not; lambda_n is the node's own ``mask.weight``."""

    weight: float = 1.0
    """lambda_m."""

    def applies(self, frame: Frame) -> bool:
        return True

    def __call__(self, rendering: SceneRendering, frame: Frame) -> Float[Tensor, ""]:
        rows = max(sum(span.stop - span.start for span in rendering.rows.values()), 1)
        total = torch.zeros((), device=rendering.rgb.device)
        for name, term in rendering.mask_terms.items():
            scores = term.scores
            if term.visible_only:
                scores = scores * rendering.splats.visible[rendering.rows[name]]
            total = total + term.weight * scores.sum()
        return self.weight * total / rows
