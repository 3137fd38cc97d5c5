"""The paper's global importance of background Gaussians: how much each contributes to the training views."""

from collections.abc import Iterable

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.types import Contribution


class Importance:
    """Accumulates the score of every row of the whole scene, one view at a time.

    Score of row i over M views::

        I_i = 1/M sum_m [dominant_i^(m) > 0] w_i^(m) / max(S_i^(m), 1)

    w is the row's summed blend weight in the view. S is the number of pixels it was blended into, so w/S is its mean
    blend weight. The indicator is the paper's delta(i in I_max): the row is the largest contributor of at least one
    pixel of the view. The paper takes this score from Mini-Splatting (Fang & Wang 2024). Its background formula omits
    the indicator, but without it only rows that touch no training pixel score zero.

    A row with score zero may still be visible. Where many soft rows overlap, a row that dominates no pixel still adds
    light; the training steps after the removal make up for it. Render all nodes of the scene for the contributions,
    because what stands in front decides what dominates. Then select the background rows of ``scores()``.

    >>> view = Contribution(torch.tensor([3.0, 1.0]).double(), torch.tensor([4, 4]), torch.tensor([4, 0]))
    >>> importance = Importance()
    >>> importance.add(view)
    >>> importance.scores().tolist()
    [0.75, 0.0]
    """

    def __init__(self, gate: bool = True, *, per_pixel: bool = True) -> None:
        """``gate=False`` omits the indicator, ``per_pixel=False`` the division by S."""
        self.gate, self.per_pixel = gate, per_pixel
        self.views = 0
        # float64, because float32 sums of many views depend on their order, and thresholds are exactly zero.
        self._total: Float64[Tensor, " n"] | None = None

    def add(self, contribution: Contribution) -> None:
        """Adds one view.

        Raises ValueError if the view has another number of rows than the views before, or a weight that is NaN,
        infinite or negative.
        """
        weight = contribution.weight.double()
        bad = ~(weight.isfinite() & (weight >= 0))
        if bad.any():
            row = int(bad.nonzero()[0])
            raise ValueError(
                f"blend weights must be finite and >= 0, but row {row} of view {self.views} has {float(weight[row])}: "
                "look for NaN in the Gaussians before scoring them"
            )
        if self._total is not None and self._total.shape != weight.shape:
            raise ValueError(
                f"every view must score the same rows, but view {self.views} has {weight.shape[0]} and those before "
                f"{self._total.shape[0]}: start a new Importance after rows were added or removed"
            )
        score = weight / contribution.pixels.clamp(min=1) if self.per_pixel else weight
        if self.gate:
            score = torch.where(contribution.dominant > 0, score, 0.0)
        self._total = score if self._total is None else self._total + score
        self.views += 1

    def scores(self, ranks: Ranks = ALONE) -> Float64[Tensor, " n"]:
        """Returns I_i over the views of all processes; per pixel it lies in [0, 1].

        Raises ValueError before the first view: zero scores would remove the whole scene.
        """
        if self._total is None:
            raise ValueError("importance needs at least one view, got none: add the training views first")
        return ranks.sum(self._total.clone()) / ranks.sum(torch.tensor(self.views, device=self._total.device))


def measure_importance(views: Iterable[Contribution], gate: bool = True) -> Float64[Tensor, " n"]:
    """Returns the scores of all rows over all views; see ``Importance`` for the formula and the errors raised.

    >>> view = Contribution(torch.tensor([3.0, 1.0]).double(), torch.tensor([4, 4]), torch.tensor([4, 0]))
    >>> measure_importance([view], gate=False).tolist()
    [0.75, 0.25]
    """
    importance = Importance(gate)
    for view in views:
        importance.add(view)
    return importance.scores()
