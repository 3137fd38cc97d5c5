"""The result of a pure function that decides which Gaussians to keep, copy or split."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Int
from torch import Tensor


@dataclass(frozen=True)
class RowPlan:
    """A plan by which new row i is a copy of old row source[i]; parameters, optimizer moments and buffers follow it.

    Raises ValueError if a source is not a row of the table that the plan was made for.

    >>> plan = RowPlan(rows=2, source=torch.tensor([0, 1, 1]), fresh=torch.tensor([False, False, True]))
    >>> len(plan.source)
    3
    """

    rows: int
    """Number of rows of the table that the plan was made for; a stale plan must not be applied to another table."""
    source: Int[Tensor, " new"]
    fresh: Bool[Tensor, " new"]
    """Whether a new row's optimizer moments start at zero."""
    edits: dict[str, Tensor] = field(default_factory=dict)
    """Name of a parameter or buffer -> values [new, ...] that replace its column, for rows that are not copies."""
    reset_moments: frozenset[str] = frozenset()
    """Names of parameters whose moments start at zero in every row (an opacity reset)."""
    inherited_second_moments: frozenset[str] = frozenset()
    """Names of parameters of which fresh rows begin with their source's second moments. With zeros, which Adam takes
    for true after its first thousand steps, one gradient moves a parameter by 0.1 / sqrt(0.001) = 3.2 rates at once,
    and by 32 until its first moment has died away."""

    def __post_init__(self) -> None:
        if len(self.source) != len(self.fresh):
            raise ValueError(f"fresh must have one entry per new row: {len(self.fresh)} for {len(self.source)}")
        if len(self.source) and not 0 <= int(self.source.min()) <= int(self.source.max()) < self.rows:
            low, high = int(self.source.min()), int(self.source.max())
            raise ValueError(f"the plan's sources {low} to {high} must lie in the table of {self.rows} rows")

    @staticmethod
    def keep(mask: Bool[Tensor, " old"]) -> "RowPlan":
        """Returns the plan that keeps the rows where ``mask`` is true, in order.

        >>> RowPlan.keep(torch.tensor([True, False, True])).source.tolist()
        [0, 2]
        """
        source = torch.nonzero(mask).squeeze(-1)
        return RowPlan(len(mask), source, torch.zeros_like(source, dtype=torch.bool))
