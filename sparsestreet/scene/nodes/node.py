"""What every node class of the scene graph has in common."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.masks import StaticMask
from sparsestreet.types import Gaussians

BYTES_PER_NUMBER = 4
"""Sizes are stated as float32, whatever precision a test or an optimizer holds them in."""

OPACITY_LOGIT_LIMIT = 15.0
"""sigmoid(15) = 1 - 3e-7: beyond it float32 knows no gradient any more, and exp would only gather overflow."""


@dataclass(frozen=True)
class MaskTerm:
    """What the sparsity loss needs of one node."""

    scores: Float[Tensor, " n"]
    """sigma(m), float32."""
    weight: float
    """lambda_n of the paper."""
    visible_only: bool = False
    """Whether the loss sums over the rows drawn in the view only."""


class Node(nn.Module, ABC):
    """One node class: a table of Gaussians with an optional mask.

    The rows hold ``means``, ``log_scales``, ``quaternions``, ``opacity_logits``, ``sh_dc`` [n, 1, 3],
    ``sh_rest`` [n, k - 1, 3] and, while a mask is being trained, ``mask_logits``. They stay unmasked: only
    ``gaussians_at`` applies the mask, so densification, culling and regularizers see what the mask hides
    (a scale of 0 has no logarithm and no ratio).
    """

    rows: Rows
    mask: StaticMask | None

    def __init__(self, rows: Rows, mask: StaticMask | None) -> None:
        super().__init__()
        if (mask is None) != ("mask_logits" not in rows.columns()):
            raise ValueError(
                f"a mask and the column 'mask_logits' come together, got mask={mask} with columns "
                f"{sorted(rows.columns())}: add mask.initial_logits(len(rows)) to the rows, or leave both out"
            )
        self.rows = rows
        self.mask = mask

    @abstractmethod
    def gaussians_at(self, time: float, sh_degree: int) -> Gaussians:
        """The node's Gaussians in the world at a normalized time, activated, with the mask applied.

        ``sh`` has (min(sh_degree, stored degree) + 1)^2 terms.
        """

    def mask_scores(self) -> Float[Tensor, " n"] | None:
        """sigma(m) of every row, float32; None without a mask, or once its logits have been dropped."""
        if self.mask is None or "mask_logits" not in self.rows.columns():
            return None
        return self.mask.scores(self.rows.mask_logits)

    def activated(self, sh_degree: int) -> Gaussians:
        """The rows in their own frame, activated: opacities and scales times the mask's 0 or 1."""
        rows = self.rows
        opacities = torch.sigmoid(rows.opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT))
        scales = torch.exp(rows.log_scales)
        scores = self.mask_scores()
        if scores is not None:
            multipliers = self.mask.multipliers(scores)
            opacities, scales = opacities * multipliers, scales * multipliers[:, None]
        rest = rows.sh_rest[:, : (sh_degree + 1) ** 2 - 1]
        sh = torch.cat((rows.sh_dc, rest), dim=1) if rest.shape[1] else rows.sh_dc
        return Gaussians(rows.means, rows.quaternions, scales, opacities, sh)

    def row_bytes(self) -> int:
        """float32 bytes of the rows without their masks (an instance number counts as one number)."""
        numbers = sum(column.numel() for name, column in self.rows.columns().items() if name != "mask_logits")
        return BYTES_PER_NUMBER * numbers

    def pose_bytes(self) -> int:
        """float32 bytes of what moves the rows over time; 0 for a node that stands still."""
        return 0
