"""Rules of other papers, from their formulas, as opponents at equal count: Mini-Splatting and LightGaussian."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.pruning.counts import Keep, check_keep, keep_counts
from sparsestreet.pruning.importance import Importance
from sparsestreet.pruning.rule import PruningRule, RenderContext, contributions
from sparsestreet.scene.gaussians import Rows, Selection
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame


@dataclass(frozen=True)
class WeightRule(PruningRule):
    """Keeps a given number of each node's rows by the sum of their blend weights alpha * transmittance over all views.

    The weights come from renders of the whole scene.
    """

    keep: Keep
    """How many rows stay (see ``counts.Keep``)."""
    gate: bool = False
    """Whether a view counts only for rows that are the largest contributor of one of its pixels."""

    def __post_init__(self) -> None:
        check_keep(self.keep)

    @abstractmethod
    def scores(self, name: str, rows: Rows, weights: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        """Returns the scores that rank a node's rows; ``weights``: mean over the views of the summed blend weight."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        sums, areas = Importance(self.gate, per_pixel=False), self.areas(scene)
        for view, spans in contributions(scene, frames, context):
            sums.add(view)
            areas.add(view, spans)
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
