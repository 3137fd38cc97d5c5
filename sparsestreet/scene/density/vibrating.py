"""Density control of Gaussians that vibrate (Periodic Vibration Gaussian), and their vibration itself."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.ops.raw import OPACITY_LOGIT_LIMIT
from sparsestreet.scene.density.gradient import GradientDensity
from sparsestreet.scene.density.strategy import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan, Rows


def displacements(velocities: Float[Tensor, "n 3"], ages: Float[Tensor, " n"], cycle: float) -> Float[Tensor, "n 3"]:
    """Return v sin(age a) / a with a = 2 pi / cycle, meters. The Gaussian moves with v at its life peak, never far.

    >>> displacements(torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([0.0]), cycle=0.2).tolist()
    [[0.0, 0.0, 0.0]]
    """
    rate = 2 * math.pi / cycle
    return velocities * (torch.sin(ages * rate) / rate)[:, None]


def mean_velocities(
    velocities: Float[Tensor, "n 3"], log_life_spans: Float[Tensor, " n"], cycle: float
) -> Float[Tensor, "n 3"]:
    """Return v exp(-rho / 2) with the staticness rho = life span / cycle; a Gaussian of many swings goes nowhere.

    >>> mean_velocities(torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([-100.0]), cycle=0.2).tolist()
    [[2.0, 0.0, 0.0]]
    """
    return velocities * torch.exp(-0.5 / cycle * log_life_spans.exp())[:, None]


def faded_logits(opacity_logits: Float[Tensor, " n"], log_factors: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Return the logit of sigmoid(logit) exp(log_factor), for log factors <= 0; exact if the product is close to 1.

    >>> torch.sigmoid(faded_logits(torch.zeros(1), torch.tensor([0.5]).log())).tolist()
    [0.25]
    """
    limited = opacity_logits.clamp(-OPACITY_LOGIT_LIMIT, OPACITY_LOGIT_LIMIT)
    log_opacity = torch.nn.functional.logsigmoid(limited) + log_factors
    return log_opacity - torch.log(-torch.expm1(log_opacity))


@dataclass(frozen=True)
class VibratingDensity(GradientDensity):
    """The strategy of 3DGS for rows with velocities, life peaks and life spans, as DriveStudio has it for PVG.

    Let g be the mean screen gradient of a row, h its mean absolute gradient of the life peak, s its life span, d the
    distance from the middle of the rows and R the scene radius, both in meters. A row grows if g > grad_threshold or
    h > peak_threshold. In space it is split if its largest scale exceeds split_scale max(d R - 1, 1), else cloned. In
    time, where h > peak_threshold, it is split if s > split_span, else cloned. Either is enough: a row that is small
    and lives long, which is the usual case, is cloned in space and split in time.

    Lengths grow with the distance because far things in a street are large (PVG's gamma is max(d R - 1, 1) / R).
    DriveStudio measures d from the middle of the scene; at limits of tens of meters it makes no difference.
    """

    peak_threshold: float = 0.002
    """Mean absolute gradient of the life peak above which a row is cloned or split."""
    split_span: float = 0.01
    """In the node's time: of the rows with such a gradient, those that live longer are split, the others cloned."""
    cycle: float = 0.2
    """The cycle of the node."""

    watched: ClassVar[Sequence[str]] = ("life_peaks",)

    def urgency(self, statistics: DensityStatistics) -> Float[Tensor, " n"]:
        return torch.maximum(super().urgency(statistics), self._urgency_in_time(statistics))

    def split_size(self, rows: Rows, radius: float) -> Float[Tensor, " n"]:
        return self.split_scale * _lengths(rows, radius)

    def cull_size(self, rows: Rows, radius: float) -> Float[Tensor, " n"]:
        return self.cull_scale * _lengths(rows, radius)

    def decisions(
        self, rows: Rows, statistics: DensityStatistics, large: Bool[Tensor, " n"]
    ) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
        in_time = self._urgency_in_time(statistics) > 1
        long_lived = rows.log_life_spans.detach().exp() > self.split_span
        return large | (in_time & long_lived), ~large | (in_time & ~long_lived)

    def grow(
        self, rows: Rows, split: Bool[Tensor, " n"], clone: Bool[Tensor, " n"], generator: torch.Generator
    ) -> RowPlan:
        """Return the plan of 3DGS with children spread over time, whether they were split in space or in time.

        Children peak at tau + s z, z ~ N(0, 1), where s is their parent's life span. They are moved to that time by the
        parent's mean velocity, and live as long as the parent (``no_time_split`` of DriveStudio). As there, parent and
        children of a split in time alone shrink in space too.
        """
        plan = super().grow(rows, split, clone, generator)
        first_child = len(plan.source) - self.split_children * int(split.sum())
        children = plan.source[first_child:]
        log_spans, velocities = rows.log_life_spans.detach()[children], rows.velocities.detach()[children]
        normal = torch.randn(len(children), generator=generator, device=generator.device).to(log_spans)
        later = log_spans.exp() * normal
        peaks = rows.life_peaks.detach()[plan.source]
        peaks[first_child:] += later
        plan.edits["means"][first_child:] += later[:, None] * mean_velocities(velocities, log_spans, self.cycle)
        return replace(plan, edits=plan.edits | {"life_peaks": peaks})

    def _urgency_in_time(self, statistics: DensityStatistics) -> Float[Tensor, " n"]:
        return statistics.mean_gradients("life_peaks") / self.peak_threshold


def _lengths(rows: Rows, radius: float) -> Float[Tensor, " n"]:
    """Return max(d R - 1, 1), which stands for the scene radius in sizes of rows."""
    means = rows.means.detach()
    distances = (means - means.quantile(0.5, dim=0)).norm(dim=1) if len(rows) else means.new_zeros(0)
    return (distances * radius - 1).clamp(min=1)
