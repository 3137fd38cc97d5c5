"""What a pure function answers when asked which Gaussians to keep, copy or split."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Int
from torch import Tensor


@dataclass(frozen=True)
class RowPlan:
    """New row i is a copy of old row source[i]; parameters, optimizer moments and buffers all follow it.

    Raises ValueError if a source is no row of the table that the plan was made for.
    """

    rows: int
    """Number of rows the plan was made for: a stale plan must not be applied to another table."""
    source: Int[Tensor, " new"]
    fresh: Bool[Tensor, " new"]
    """True: the row's optimizer moments start at zero."""
    edits: dict[str, Tensor] = field(default_factory=dict)
    """Name of a parameter or buffer -> full replacement values [new, ...], for rows that are no plain copies."""
    reset_moments: frozenset[str] = frozenset()
    """Names of parameters whose moments start at zero in every row (an opacity reset)."""

    def __post_init__(self) -> None:
        if len(self.source) != len(self.fresh):
            raise ValueError(f"fresh must have one entry per new row: {len(self.fresh)} for {len(self.source)}")
        if len(self.source) and not 0 <= int(self.source.min()) <= int(self.source.max()) < self.rows:
            low, high = int(self.source.min()), int(self.source.max())
            raise ValueError(f"the plan's sources {low} to {high} must lie in the table of {self.rows} rows")

    @staticmethod
    def keep(mask: Bool[Tensor, " old"]) -> "RowPlan":
        """Keep the rows where ``mask`` is true, in order."""
        source = torch.nonzero(mask).squeeze(-1)
        return RowPlan(len(mask), source, torch.zeros_like(source, dtype=torch.bool))
