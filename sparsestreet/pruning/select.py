"""Which rows of a node class to keep: by learned mask or by importance, never fewer than K_min."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.gaussians import RowPlan


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


def keep_by_mask(scores: Float[Tensor, " n"], threshold: float, min_gaussians: int) -> Selection:
    """Drop the rows whose mask is closed, sigma(m_k) <= epsilon, lowest first, but never below ``min_gaussians``.

    ``scores`` are the sigmoids that the rasterizer's mask compares too, of all instances of the node class. Among equal
    scores at the floor the lower row stays. Raises ValueError for scores that are NaN or a negative floor.
    """
    # Compared in the scores' own dtype, as the mask does: both must agree on who is closed.
    return _keep_best(scores, scores <= threshold, min_gaussians)


def keep_by_importance(scores: Float[Tensor, " n"], min_gaussians: int) -> Selection:
    """Drop the rows with importance 0, unless that leaves fewer than ``min_gaussians``.

    At the floor the highest scores stay and, among rows of equal score (zero), the lower row. Raises ValueError for
    scores that are NaN or negative, or a negative floor.
    """
    if (scores < 0).any():
        raise ValueError(f"importance is a mean blend weight and >= 0, got {float(scores.min())}")
    return _keep_best(scores, scores == 0, min_gaussians)


def keep_by_cost(
    costs: Mapping[str, Float[Tensor, " _"]], allowed: float, min_gaussians: Mapping[str, int]
) -> dict[str, Selection]:
    """Drop the cheapest rows of all nodes together, as long as their costs add up to ``allowed`` at most.

    ``costs`` and ``min_gaussians``: by name of the node. At a node's floor its dearest rows stay and, among equals, the
    lower row. Raises ValueError for costs that are NaN or negative, or a negative floor.
    """
    everything = torch.cat([cost.double() for cost in costs.values()])
    if not (everything >= 0).all():
        raise ValueError(f"costs of removal must be numbers >= 0, got {float(everything[~(everything >= 0)][0])}")
    # Of equals the later goes first, as at the floor.
    cheapest_first = torch.sort(everything.flip(0), stable=True)
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[len(everything) - 1 - cheapest_first.indices] = cheapest_first.values.cumsum(0) <= allowed
    parts = unwanted.split([len(cost) for cost in costs.values()])
    return {name: _keep_best(costs[name], part, min_gaussians[name]) for name, part in zip(costs, parts, strict=True)}


def _keep_best(scores: Float[Tensor, " n"], unwanted: Bool[Tensor, " n"], min_gaussians: int) -> Selection:
    """Keep all that is wanted, and of the unwanted (which score lowest) only what the floor calls for."""
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
