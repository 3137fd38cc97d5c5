"""Which rows of a table stay, and the floor that no rule goes below."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.gaussians.plan import RowPlan


@dataclass(frozen=True)
class Selection:
    """Which rows stay."""

    keep: Bool[Tensor, " n"]
    floor_hit: bool
    """True: the rule wanted to remove more, but K_min kept some of its candidates."""
    removed: int

    def plan(self) -> RowPlan:
        """The kept rows, in order, with their optimizer moments."""
        return RowPlan.keep(self.keep)


def keep_best(scores: Float[Tensor, " n"], unwanted: Bool[Tensor, " n"], min_gaussians: int) -> Selection:
    """Keep all that is wanted, and of the unwanted (which score lowest) only what the floor calls for.

    Among rows of equal score at the floor the lower row stays. Raises ValueError for scores that are NaN or a negative
    floor.
    """
    if min_gaussians < 0:
        raise ValueError(f"min_gaussians must be >= 0, got {min_gaussians}")
    if scores.isnan().any():
        row = int(scores.isnan().nonzero()[0])
        raise ValueError(f"scores must be numbers, but row {row} of {scores.shape[0]} is NaN: repair it before pruning")
    rows, wanted = scores.shape[0], int((~unwanted).sum())
    kept = max(wanted, min(min_gaussians, rows))
    best_first = torch.sort(scores, descending=True, stable=True).indices
    keep = torch.zeros_like(unwanted)
    keep[best_first[:kept]] = True
    return Selection(keep, floor_hit=kept > wanted, removed=rows - kept)
