"""What a pure function answers when asked which Gaussians to keep, copy or split."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Int
from torch import Tensor


@dataclass(frozen=True)
class RowPlan:
    """New row i is a copy of old row source[i]; parameters, optimiser moments and buffers all follow it."""

    source: Int[Tensor, " new"]
    fresh: Bool[Tensor, " new"]
    """True: the row's optimiser moments start at zero."""
    edits: dict[str, Tensor] = field(default_factory=dict)
    """Name of a parameter or buffer -> full replacement values [new, ...], for rows that are no plain copies."""
    reset_moments: frozenset[str] = frozenset()
    """Names of parameters whose moments start at zero in every row (an opacity reset)."""

    @staticmethod
    def keep(mask: Bool[Tensor, " old"]) -> "RowPlan":
        """Keep the rows where ``mask`` is true, in order."""
        source = torch.nonzero(mask).squeeze(-1)
        return RowPlan(source, torch.zeros_like(source, dtype=torch.bool))
