"""Which rows of some nodes to keep, by importance or by cost, never fewer than their floors."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.pruning.floors import Floors
from sparsestreet.scene.gaussians import Selection, keep_best


def keep_by_importance(scores: Float[Tensor, " n"], floors: Floors) -> Selection:
    """Drop the rows with importance 0, unless that leaves fewer than the floors of the node or of an instance.

    At a floor the highest scores stay and, among rows of equal score (zero), the lower row. Raises ValueError for
    scores that are NaN or negative, or a negative floor.
    """
    if (scores < 0).any():
        raise ValueError(f"importance is a mean blend weight and >= 0, got {float(scores.min())}")
    return keep_best(scores, scores == 0, *floors)


def keep_by_cost(
    costs: Mapping[str, Float[Tensor, " _"]], allowed: float, floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """Drop the cheapest rows of all nodes together, as long as their costs add up to ``allowed`` at most.

    ``costs`` and ``floors``: by name of the node. At a floor the dearest rows stay and, among equals, the lower row;
    what they would have cost is not spent on others. Raises ValueError for costs that are NaN or negative, or a
    negative floor.
    """
    if not costs:
        return {}
    everything = torch.cat([cost.double() for cost in costs.values()])
    if not (everything >= 0).all():
        raise ValueError(f"costs of removal must be numbers >= 0, got {float(everything[~(everything >= 0)][0])}")
    # Of equals the later goes first, as at the floors.
    cheapest_first = torch.sort(everything.flip(0), stable=True)
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[len(everything) - 1 - cheapest_first.indices] = cheapest_first.values.cumsum(0) <= allowed
    parts = unwanted.split([len(cost) for cost in costs.values()])
    return {name: keep_best(costs[name], part, *floors[name]) for name, part in zip(costs, parts, strict=True)}
