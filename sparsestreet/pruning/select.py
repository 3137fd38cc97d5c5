"""Selects the rows of some nodes to keep, by importance or by cost, never fewer than their floors."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from sparsestreet.pruning.floors import Floors
from sparsestreet.scene.gaussians import Selection, keep_best


def keep_by_importance(scores: Float[Tensor, " n"], floors: Floors) -> Selection:
    """Drops the rows with importance 0, but keeps enough to meet the floors of the node and its instances.

    At a floor the highest scores stay and, among rows of equal score (zero), the lower row. Raises ValueError for
    scores that are NaN or negative, or a negative floor.

    >>> keep_by_importance(torch.tensor([0.5, 0.0, 0.0]), Floors(min_gaussians=2)).keep.tolist()
    [True, True, False]
    """
    if (scores < 0).any():
        raise ValueError(f"importance is a mean blend weight and >= 0, got {float(scores.min())}")
    return keep_best(scores, scores == 0, *floors)


def keep_by_cost(
    costs: Mapping[str, Float[Tensor, " _"]], allowed: float, floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """Drops the cheapest rows of all nodes together while their costs add up to ``allowed`` at most.

    ``costs`` and ``floors`` are by name of the node. At a floor the most expensive rows stay and, among equals, the
    lower row; their cost is not spent on others. Raises ValueError for costs that are NaN or negative, or a negative
    floor.

    >>> costs = {"road": torch.tensor([0.1, 0.5]), "cars": torch.tensor([0.2])}
    >>> kept = keep_by_cost(costs, allowed=0.4, floors={"road": Floors(0), "cars": Floors(0)})
    >>> {name: selection.keep.tolist() for name, selection in kept.items()}
    {'road': [False, True], 'cars': [False]}
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
    """Drops the ``number`` rows with the lowest scores of all nodes together; otherwise as ``keep_by_cost``.

    Raises ValueError for a number that is negative or above the number of rows, or a negative floor.

    >>> keep_by_rank({"road": torch.tensor([0.1, 0.5])}, number=1, floors={"road": Floors(0)})["road"].keep.tolist()
    [False, True]
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
    """Returns rows in order of their values; among equals the later row comes first, as at the floors."""
    return len(values) - 1 - torch.sort(values.flip(0), stable=True).indices


def _keep_in_each(
    scores: Mapping[str, Float[Tensor, " _"]], unwanted: Bool[Tensor, " n"], floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """Returns the rows that stay of each node; ``unwanted`` marks the rows of all nodes one after the other."""
    parts = unwanted.split([len(score) for score in scores.values()])
    return {name: keep_best(scores[name], part, *floors[name]) for name, part in zip(scores, parts, strict=True)}
