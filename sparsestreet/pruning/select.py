"""Which rows of some nodes to keep, by importance or by cost, never fewer than K_min."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.gaussians import Selection, keep_best


def keep_by_importance(scores: Float[Tensor, " n"], min_gaussians: int) -> Selection:
    """Drop the rows with importance 0, unless that leaves fewer than ``min_gaussians``.

    At the floor the highest scores stay and, among rows of equal score (zero), the lower row. Raises ValueError for
    scores that are NaN or negative, or a negative floor.
    """
    if (scores < 0).any():
        raise ValueError(f"importance is a mean blend weight and >= 0, got {float(scores.min())}")
    return keep_best(scores, scores == 0, min_gaussians)


def keep_by_cost(
    costs: Mapping[str, Float[Tensor, " _"]], allowed: float, min_gaussians: Mapping[str, int]
) -> dict[str, Selection]:
    """Drop the cheapest rows of all nodes together, as long as their costs add up to ``allowed`` at most.

    ``costs`` and ``min_gaussians``: by name of the node. At a node's floor its dearest rows stay and, among equals, the
    lower row. Raises ValueError for costs that are NaN or negative, or a negative floor.
    """
    if not costs:
        return {}
    everything = torch.cat([cost.double() for cost in costs.values()])
    if not (everything >= 0).all():
        raise ValueError(f"costs of removal must be numbers >= 0, got {float(everything[~(everything >= 0)][0])}")
    # Of equals the later goes first, as at the floor.
    cheapest_first = torch.sort(everything.flip(0), stable=True)
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[len(everything) - 1 - cheapest_first.indices] = cheapest_first.values.cumsum(0) <= allowed
    parts = unwanted.split([len(cost) for cost in costs.values()])
    return {name: keep_best(costs[name], part, min_gaussians[name]) for name, part in zip(costs, parts, strict=True)}
