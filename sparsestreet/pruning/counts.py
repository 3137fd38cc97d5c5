"""Given numbers of Gaussians: how many of each node's rows a pass leaves, for comparisons of rules at equal count."""

from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from sparsestreet.pruning.floors import Floors
from sparsestreet.pruning.rule import RenderContext
from sparsestreet.pruning.select import keep_by_rank
from sparsestreet.scene.gaussians import Selection

Keep = int | float | Mapping[str, int | float]
"""One value for every node, or name of a node -> its value; a node without a value keeps all rows. Values up to 1 are
fractions of the rows before the first pass; larger ones are numbers of rows."""


def check_keep(keep: Keep) -> None:
    """Raises ValueError for a value that is neither a fraction nor a number of rows."""
    values = keep.values() if isinstance(keep, Mapping) else (keep,)
    wrong = [value for value in values if not value >= 0]
    if wrong:
        raise ValueError(f"keep must be a fraction in [0, 1] or a number of Gaussians, got {wrong[0]}")


def keep_counts(
    scores: Mapping[str, Float[Tensor, " _"]], keep: Keep, floors: Mapping[str, Floors], context: RenderContext
) -> dict[str, Selection]:
    """Keeps so many rows of each node, those with the highest scores, or more if a floor demands it.

    Of several passes each leaves the same share of a node's rows, and the last one leaves ``keep``. Among rows of equal
    score the lower one stays. Raises ValueError for scores that are NaN, or a negative floor.

    >>> import torch
    >>> kept = keep_counts({"road": torch.tensor([0.1, 0.9, 0.5])}, 2, {"road": Floors(0)}, RenderContext())
    >>> kept["road"].keep.tolist()
    [False, True, True]
    """
    selections = {}
    for name, floor in floors.items():
        rows = len(scores[name])
        going = rows - min(_count(keep, name, rows, context), rows)
        selections |= keep_by_rank({name: scores[name]}, going, {name: floor})
    return selections


def _count(keep: Keep, name: str, rows: int, context: RenderContext) -> int:
    value = keep.get(name, 1.0) if isinstance(keep, Mapping) else keep
    if value <= 1:
        return round(rows * value ** (1 / context.passes))
    left = context.passes - context.passed
    return round(rows * (value / max(rows, 1)) ** (1 / left))
