"""Selects the rows of a table that stay, never fewer than the floors."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.scene.gaussians.plan import RowPlan


@dataclass(frozen=True)
class Selection:
    """The rows that stay."""

    keep: Bool[Tensor, " n"]
    floor_hit: bool
    """Whether K_min or the floor of an instance kept rows that the rule wanted to remove."""
    removed: int

    def plan(self) -> RowPlan:
        """Returns the plan that keeps these rows in order, with their optimizer moments."""
        return RowPlan.keep(self.keep)


@dataclass(frozen=True)
class InstanceFloors:
    """The least number of rows of each instance of a node; an instance that has fewer keeps all."""

    ids: Int[Tensor, " n"]
    """Row -> its instance."""
    least: Int[Tensor, " i"]


def keep_best(
    scores: Float[Tensor, " n"],
    unwanted: Bool[Tensor, " n"],
    min_gaussians: int,
    instances: InstanceFloors | None = None,
) -> Selection:
    """Drops the unwanted rows, but keeps enough of them to meet the floors.

    Each instance first fills up to its own floor. Then the best of the rest fill up to ``min_gaussians``. The highest
    scores stay and, among rows of equal score, the lower row. Raises ValueError for scores that are NaN or a negative
    floor.

    >>> scores = torch.tensor([0.9, 0.1, 0.2])
    >>> selection = keep_best(scores, unwanted=scores < 0.5, min_gaussians=2)
    >>> selection.keep.tolist(), selection.floor_hit, selection.removed
    ([True, False, True], True, 1)
    """
    if min_gaussians < 0:
        raise ValueError(f"min_gaussians must be >= 0, got {min_gaussians}")
    if scores.isnan().any():
        row = int(scores.isnan().nonzero()[0])
        raise ValueError(f"scores must be numbers, but row {row} of {scores.shape[0]} is NaN: repair it before pruning")
    best_first = torch.sort(scores, descending=True, stable=True).indices
    best_first = best_first[torch.sort(unwanted[best_first].byte(), stable=True).indices]
    keep = ~unwanted
    wanted = int(keep.sum())
    if instances is not None:
        keep[best_first[_within_floors(instances.ids[best_first], instances.least)]] = True
    missing = max(min_gaussians - int(keep.sum()), 0)
    keep[best_first[~keep[best_first]][:missing]] = True
    kept = int(keep.sum())
    return Selection(keep, floor_hit=kept > wanted, removed=scores.shape[0] - kept)


def _within_floors(ids: Int[Tensor, " n"], least: Int[Tensor, " i"]) -> Bool[Tensor, " n"]:
    """Returns whether each row is within its instance's floor, counted from the first row; rows come best first."""
    by_instance = torch.sort(ids, stable=True)
    counts = torch.bincount(ids, minlength=len(least))
    place = torch.arange(len(ids), device=ids.device) - (counts.cumsum(0) - counts)[by_instance.values]
    within = torch.zeros_like(ids, dtype=torch.bool)
    within[by_instance.indices] = place < least[by_instance.values]
    return within
