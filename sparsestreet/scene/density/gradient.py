"""Gradient-based density control (3DGS, Kerbl et al. 2023; absolute gradients as in AbsGS, Ye et al. 2024).

The decisions are pure functions of rows and statistics, and return a RowPlan. They use unmasked values, because a
closed mask would make the scale 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.scene.density.strategy import DensityStatistics, DensityStrategy
from sparsestreet.scene.gaussians import RowPlan, Rows


@dataclass(frozen=True)
class GradientDensity(DensityStrategy):
    """Clones, splits, culls and resets by thresholds; the defaults are DriveStudio's for its background node.

    Raises ValueError for thresholds that contradict each other.

    >>> scales = torch.full((2, 3), 0.1).log()
    >>> rows = Rows({"log_scales": scales, "opacity_logits": torch.tensor([2.0, -9.0])})
    >>> GradientDensity().cull(rows, DensityStatistics(2), radius=10.0, progress=0.5).source.tolist()
    [0]
    """

    grad_threshold: float = 0.0003
    """Mean screen gradient above which a row is cloned or split."""
    split_scale: float = 0.003
    """Fraction of the scene radius: larger rows are split, smaller ones cloned."""
    split_screen: float = 0.05
    """Fraction of the longer image side: rows that were larger on screen are split at any scale."""
    cull_opacity: float = 0.005
    """Rows with a lower opacity are culled."""
    cull_scale: float = 0.5
    """Fraction of the scene radius: larger rows are culled."""
    cull_scale_from: float = 0.1
    """Fraction of the run after which ``cull_scale`` applies: early Gaussians are large because there are few."""
    cull_screen: float = 0.15
    """Fraction of the longer image side: rows that were larger on screen are culled, where ``cull_scale`` applies."""
    screen_size_until: float = 0.0
    """Fraction of the run up to which ``split_screen`` and ``cull_screen`` apply; 0: never. (DriveStudio: 0.133 for
    its background, 1 for its rigid node.)"""
    split_children: int = 2
    split_shrink: float = 1.6
    """Factor by which the scales of children (and of a parent that stays) are divided."""
    keep_parent: bool = True
    """Whether the shrunk parent stays next to its children, as in DriveStudio; the original 3DGS replaces it."""
    clone_shrunk: bool = False
    """Whether a parent that stays is cloned too if it has become small. DriveStudio splits first, then clones what is
    small."""
    steady_means: bool = True
    """Whether the means of clones and children begin with their parent's second moments, so that Adam does not throw
    them from where they were put (``RowPlan.inherited_second_moments``). False: 3DGS and DriveStudio."""
    reset_opacity_to: float = 0.01
    """Largest opacity after a reset."""

    watched: ClassVar[Sequence[str]] = ()

    def __post_init__(self) -> None:
        if self.split_children < 2:
            raise ValueError(f"a split needs at least 2 children, got split_children={self.split_children}")
        if self.clone_shrunk and not self.keep_parent:
            raise ValueError("clone_shrunk clones parents that stay: set keep_parent=True, or leave it out")
        if self.split_shrink < 1:
            raise ValueError(f"children must not be larger than their parent, got split_shrink={self.split_shrink}")
        if not 0 < self.reset_opacity_to < 1:
            raise ValueError(f"opacities are reset to a value between 0 and 1, got {self.reset_opacity_to}")

    def densify(
        self,
        rows: Rows,
        statistics: DensityStatistics,
        *,
        radius: float,
        progress: float,
        max_gaussians: int | None,
        generator: torch.Generator,
    ) -> RowPlan:
        """Clones small rows and splits large ones where the image asks for detail.

        Let g be the mean screen gradient, s_max the largest scale, r the largest screen size and R = ``radius`` the
        scene radius in meters. A row with g > grad_threshold (``urgency`` > 1) is split if s_max > split_scale R (or,
        up to ``screen_size_until``, r > split_screen), else cloned. (With ``clone_shrunk`` a row is cloned where its
        scale, after the split, is at most split_scale R.) A clone is an exact copy. Children of a split are
        drawn from their parent: at mu + R(q) (s * z) with z ~ N(0, I), with scales s / split_shrink. Copies inherit all
        other columns (mask logits, instances ...) and start with zero optimizer moments, but for ``steady_means``;
        parents keep theirs.

        The new order is: the surviving rows in their old order, then clones, then children, siblings side by side.
        Raises ValueError if the statistics do not belong to the rows or hold a gradient that is not finite.
        """
        _check_same_rows(rows, statistics)
        urgency = self.urgency(statistics)
        wanted = urgency > 1
        scale, limit = _largest_scale(rows), self.split_size(rows, radius)
        large = scale > limit
        if progress <= self.screen_size_until:
            large = large | (statistics.largest_screen > self.split_screen)
        split, clone = self.decisions(rows, statistics, large)
        if self.clone_shrunk:
            clone = clone | (split & (scale / self.split_shrink <= limit))
        wanted = wanted & _within_cap(urgency, wanted, split, clone, self, max_gaussians)
        return self.grow(rows, wanted & split, wanted & clone, generator)

    def urgency(self, statistics: DensityStatistics) -> Float[Tensor, " n"]:
        """Return how much detail the image asks of each row; rows above 1 are cloned or split, the highest first."""
        return statistics.mean_gradients() / self.grad_threshold

    def split_size(self, rows: Rows, radius: float) -> float | Float[Tensor, " n"]:
        """Return the largest scale, meters, up to which a row is cloned."""
        return self.split_scale * radius

    def cull_size(self, rows: Rows, radius: float) -> float | Float[Tensor, " n"]:
        """Return the largest scale, meters, that a row may have late in a run."""
        return self.cull_scale * radius

    def decisions(
        self, rows: Rows, statistics: DensityStatistics, large: Bool[Tensor, " n"]
    ) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
        """Return which rows are split and which are cloned if they grow; ``large``: those above ``split_size``."""
        return large, ~large

    def grow(
        self, rows: Rows, split: Bool[Tensor, " n"], clone: Bool[Tensor, " n"], generator: torch.Generator
    ) -> RowPlan:
        """Return the plan that splits and clones the given rows; the children come last.

        A row of both kinds shrinks first, and is cloned as it is then.
        """
        survivors = torch.nonzero(torch.ones_like(split) if self.keep_parent else ~split).squeeze(-1)
        clones = torch.nonzero(clone).squeeze(-1)
        children = torch.nonzero(split).squeeze(-1).repeat_interleave(self.split_children)
        source = torch.cat((survivors, clones, children))
        fresh = torch.arange(len(source), device=source.device) >= len(survivors)

        means = rows.means.detach()[source]
        first_child = len(survivors) + len(clones)
        means[first_child:] += _offsets(rows, children, generator)
        log_scales = rows.log_scales.detach()[source]
        log_scales[split[source]] -= math.log(self.split_shrink)
        inherited = frozenset({"means"} if self.steady_means else ())
        edits = {"means": means, "log_scales": log_scales}
        return RowPlan(len(rows), source, fresh, edits, inherited_second_moments=inherited)

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        """Drops rows that are faint (opacity < cull_opacity) or too large.

        After ``cull_scale_from`` it drops rows whose largest scale exceeds cull_scale * ``radius``, meters, and, up to
        ``screen_size_until``, rows that were larger than ``cull_screen`` on screen. Raises ValueError if the statistics
        do not belong to the rows.
        """
        _check_same_rows(rows, statistics)
        drop = torch.sigmoid(rows.opacity_logits.detach()) < self.cull_opacity
        if progress > self.cull_scale_from:
            drop = drop | (_largest_scale(rows) > self.cull_size(rows, radius))
            if progress <= self.screen_size_until:
                drop = drop | (statistics.largest_screen > self.cull_screen)
        return RowPlan.keep(~drop)

    def reset(self, rows: Rows) -> RowPlan:
        """Lowers every opacity to at most ``reset_opacity_to`` and clears its moments; rows that matter grow back."""
        logits = rows.opacity_logits.detach()
        source = torch.arange(len(rows), device=logits.device)
        lowered = logits.clamp(max=math.log(self.reset_opacity_to / (1 - self.reset_opacity_to)))
        return RowPlan(
            len(rows),
            source,
            fresh=torch.zeros_like(source, dtype=torch.bool),
            edits={"opacity_logits": lowered},
            reset_moments=frozenset({"opacity_logits"}),
        )


def outside_boxes(
    means: Float[Tensor, "n 3"], instances: Int[Tensor, " n"], sizes: Float[Tensor, "i 3"], margin: float
) -> Bool[Tensor, " n"]:
    """Return whether each row's center lies more than ``margin`` meters outside the box of its instance.

    ``means`` are in the frame of the box, meters. ``sizes`` are length, width and height of each instance's box, which
    is centered at the origin.

    >>> means, size = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), torch.tensor([[4.0, 2.0, 1.5]])
    >>> outside_boxes(means, torch.tensor([0, 0]), size, margin=0.1).tolist()
    [False, True]
    """
    return (means.detach().abs() > sizes[instances] / 2 + margin).any(dim=-1)


def _check_same_rows(rows: Rows, statistics: DensityStatistics) -> None:
    if len(rows) != len(statistics):
        raise ValueError(
            f"the node has {len(rows)} rows but its statistics {len(statistics)}: apply every RowPlan to both"
        )


def _largest_scale(rows: Rows) -> Float[Tensor, " n"]:
    return rows.log_scales.detach().amax(dim=-1).exp()


def _within_cap(
    urgency: Float[Tensor, " n"],
    wanted: Bool[Tensor, " n"],
    split: Bool[Tensor, " n"],
    clone: Bool[Tensor, " n"],
    settings: GradientDensity,
    max_gaussians: int | None,
) -> Bool[Tensor, " n"]:
    """Return the rows that may grow under the cap: most urgent first, ties by row, until one has no room."""
    if max_gaussians is None:
        return torch.ones_like(wanted)
    split_growth = settings.split_children if settings.keep_parent else settings.split_children - 1
    growth = (split_growth * split + 1 * clone) * wanted
    order = torch.sort(urgency, descending=True, stable=True).indices
    room = max(max_gaussians - wanted.shape[0], 0)
    allowed = torch.zeros_like(wanted)
    allowed[order] = growth[order].cumsum(0) <= room
    return allowed


def _offsets(rows: Rows, children: Int[Tensor, " c"], generator: torch.Generator) -> Float[Tensor, "c 3"]:
    """Return one draw from each listed row's Gaussian, relative to its mean, meters."""
    scales = rows.log_scales.detach()[children].exp()
    # Draw on the generator's device, because a CPU generator gives the same children on every device.
    normal = torch.randn(scales.shape, dtype=scales.dtype, generator=generator, device=generator.device)
    rotations = to_matrix(rows.quaternions.detach()[children])
    return (rotations @ (scales * normal.to(scales.device))[..., None]).squeeze(-1)
