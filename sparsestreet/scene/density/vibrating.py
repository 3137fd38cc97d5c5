"""Density control of PVG (Chen et al. 2023): Gaussians that are missing at some time are grown over time as well."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.density.gradient import GradientDensity
from sparsestreet.scene.density.statistics import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan, Rows
from sparsestreet.scene.vibration import mean_velocities

NEAREST = 1.0
"""Meters; what lies nearer to the center of the scene may be as large as what lies here."""


@dataclass(frozen=True)
class VibratingDensity(GradientDensity):
    """As 3DGS, for rows with velocities, life peaks and life spans.

    A row also grows where the image pulls at its life peak, and is split above ``split_scale`` times its distance from
    the middle of the rows: streets reach far, and what is far is large. Children are spread over their parent's life.
    """

    peak_threshold: float = 0.002
    """Mean absolute gradient of the life peak above which a row is cloned or split."""
    cycle: float = 0.2
    """That of the node."""

    watched: ClassVar[tuple[str, ...]] = ("life_peaks",)

    def urgency(self, statistics: DensityStatistics) -> Float[Tensor, " n"]:
        over_time = statistics.mean_gradients("life_peaks") / self.peak_threshold
        return torch.maximum(super().urgency(statistics), over_time)

    def split_size(self, rows: Rows, radius: float) -> Float[Tensor, " n"]:
        means = rows.means.detach()
        distances = (means - means.quantile(0.5, dim=0)).norm(dim=1) if len(rows) else means.new_zeros(0)
        return self.split_scale * distances.clamp(min=NEAREST)

    def grow(
        self, rows: Rows, split: Bool[Tensor, " n"], clone: Bool[Tensor, " n"], generator: torch.Generator
    ) -> RowPlan:
        """Children peak at tau + s z, z ~ N(0, 1), with s their parent's life span, and are moved there by its mean
        velocity."""
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
