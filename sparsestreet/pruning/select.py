"""Which rows of some nodes to keep, by importance or by cost, never fewer than their floors."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int64
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

    ``costs`` and ``floors``: by name of the node. At a floor the most expensive rows stay and, among equals, the lower
    row; their cost is not spent on others. Raises ValueError for costs that are NaN or negative, or a negative floor.
    """
    if not costs:
        return {}
    everything = torch.cat([cost.double() for cost in costs.values()])
    if not (everything >= 0).all():
        raise ValueError(f"costs of removal must be numbers >= 0, got {float(everything[~(everything >= 0)][0])}")
    order = _lowest_first(everything)
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[order] = everything[order].cumsum(0) <= allowed
    return _keep_in_each(costs, unwanted, floors)


def keep_by_rank(
    scores: Mapping[str, Float[Tensor, " _"]], number: int, floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """Drop so many rows of the lowest score, of all nodes together; otherwise as ``keep_by_cost``.

    Raises ValueError for a number that is negative or more than there are, or a negative floor.
    """
    everything = torch.cat([score.double() for score in scores.values()]) if scores else torch.zeros(0)
    if not 0 <= number <= len(everything):
        raise ValueError(
            f"{number:,} rows are to go, and the nodes that the rule may take from have {len(everything):,}: take "
            "fewer, or let it take from more nodes"
        )
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[_lowest_first(everything)[:number]] = True
    return _keep_in_each(scores, unwanted, floors)


def _lowest_first(values: Float[Tensor, " n"]) -> Int64[Tensor, " n"]:
    """Rows in order of their values; of equals the later comes first, as at the floors."""
    return len(values) - 1 - torch.sort(values.flip(0), stable=True).indices


def _keep_in_each(
    scores: Mapping[str, Float[Tensor, " _"]], unwanted: Bool[Tensor, " n"], floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """What stays of each node, when the rows of all nodes are marked one after the other."""
    parts = unwanted.split([len(score) for score in scores.values()])
    return {name: keep_best(scores[name], part, *floors[name]) for name, part in zip(scores, parts, strict=True)}
