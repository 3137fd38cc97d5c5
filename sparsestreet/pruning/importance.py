"""The paper's global importance of background Gaussians: how much each contributes to the training views."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.pruning.select import Keep, PruningRule, RenderContext, check_keep, contributions, keep_counts
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.gaussians import Rows, Selection
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Contribution, Frame


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
        """Add one view.

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
        """Return I_i over the views of all processes; per pixel it lies in [0, 1].

        Raises ValueError before the first view: zero scores would remove the whole scene.
        """
        if self._total is None:
            raise ValueError("importance needs at least one view, got none: add the training views first")
        return ranks.sum(self._total.clone()) / ranks.sum(torch.tensor(self.views, device=self._total.device))


@dataclass(frozen=True)
class _NumberRule(PruningRule):
    """Keeps a given number of each node's rows, those with the highest scores, or more if a floor demands it."""

    keep: Keep
    """How many rows stay (see ``select.Keep``)."""

    def __post_init__(self) -> None:
        check_keep(self.keep)


@dataclass(frozen=True)
class WeightRule(_NumberRule):
    """Scores rows by the sum of their blend weights alpha * transmittance over all views.

    The weights come from renders of the whole scene.
    """

    gate: bool = False
    """Whether a view counts only for rows that are the largest contributor of one of its pixels."""

    @abstractmethod
    def scores(self, name: str, rows: Rows, weights: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        """Return the scores that rank a node's rows; ``weights``: mean over the views of the summed blend weight."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        sums, areas = Importance(self.gate, per_pixel=False), self.areas(scene)
        for view, spans in contributions(scene, frames, context):
            sums.add(view)
            areas.add(view.weight, spans)
        weights, floors = sums.scores(context.ranks), areas.floors(context.ranks)
        scores = {name: self.scores(name, scene.nodes[name].rows, weights[spans[name]]) for name in floors}
        return keep_counts(scores, self.keep, floors, context)


@dataclass(frozen=True)
class MiniSplattingRule(WeightRule):
    """Draws the rows that stay, without replacement and in proportion to their importance (Fang & Wang 2024).

    The importance of a row is the sum of its blend weights. With ``gate`` only views count in which it is the largest
    contributor of a pixel, the paper's intersection preserving. Rows without importance stay if there are too few
    others. A threshold keeps what is heavy, a draw also keeps some of what lies beside it. The paper's densification is
    not part of the rule.

    Efraimidis & Spirakis 2006: the k largest of I_i / e_i with e_i ~ Exp(1) are such a draw of k rows.
    """

    gate: bool = True
    seed: int = 0

    def scores(self, name: str, rows: Rows, weights: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        generator = named_generator(self.seed, f"pruning {name}")
        uniform = torch.rand(len(rows), dtype=torch.float64, generator=generator)
        # 1 - u lies in (0, 1], where the logarithm is finite; an exponential of 0 would make 0 / 0 of no importance.
        exponential = (-torch.log1p(-uniform)).clamp(min=torch.finfo(torch.float64).tiny)
        return weights / exponential.to(weights.device)


@dataclass(frozen=True)
class LightGaussianRule(WeightRule):
    """Keeps the rows of the highest global significance (Fan et al. 2023).

    Significance of row j::

        GS_j = sum over the rays that hit it of alpha_j T gamma_j,   gamma_j = min(V_j / V_90, 1)^beta

    V is the product of the scales (the volume of an ellipsoid but for a factor that cancels). V_90 is the volume that
    90 % of the node's rows do not exceed, so that floaters gain nothing by their size. The paper writes the opacity
    sigma_j where alpha_j = sigma_j times the falloff stands here: the op counts hits (``Contribution.pixels``) and sums
    alpha T, but does not sum T alone. V_90 is taken in each node, because the numbers are kept node by node.

    Raises ValueError for a negative ``beta``.
    """

    beta: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.beta >= 0:
            raise ValueError(f"beta is an exponent >= 0 of the volume, got {self.beta}")

    def scores(self, name: str, rows: Rows, weights: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        volumes = rows.log_scales.detach().double().sum(1)
        if len(volumes) == 0:
            return weights
        large = volumes.kthvalue(math.ceil(0.9 * len(volumes))).values
        return weights * (self.beta * (volumes - large).clamp(max=0)).exp()


@dataclass(frozen=True)
class CountRule(_NumberRule):
    """Scores rows without a look at any image."""

    @abstractmethod
    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Return the scores that rank a node's rows."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        floors = self.floors(scene, frames, context)
        scores = {name: self.scores(name, scene.nodes[name].rows) for name in floors}
        return keep_counts(scores, self.keep, floors, context)


@dataclass(frozen=True)
class RandomRule(CountRule):
    """Keeps rows at random."""

    seed: int = 0

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Return random numbers from the node's own stream, the same in every pass over the same rows."""
        drawn = torch.rand(len(rows), generator=named_generator(self.seed, f"pruning {name}"))
        return drawn.to(rows.means.device)


@dataclass(frozen=True)
class OpacityRule(CountRule):
    """Keeps the most opaque rows by their learned opacity, without the mask."""

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        return rows.opacity_logits
