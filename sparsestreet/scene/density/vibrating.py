"""Density control of PVG (Chen et al. 2023), which also grows Gaussians along time."""

from collections.abc import Sequence
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
"""Meters; rows nearer to the middle than this may be as large as rows at this distance."""


@dataclass(frozen=True)
class VibratingDensity(GradientDensity):
    """The strategy of 3DGS for rows with velocities, life peaks and life spans.

    A row also grows if the gradient of its life peak is large. It is split above ``split_scale`` times its distance
    from the middle of the rows, because far things in a street are large. Children are spread over their parent's life.
    """

    peak_threshold: float = 0.002
    """Mean absolute gradient of the life peak above which a row is cloned or split."""
    cycle: float = 0.2
    """The cycle of the node."""

    watched: ClassVar[Sequence[str]] = ("life_peaks",)

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
        """Returns the plan of 3DGS with children spread over time.

        Children peak at tau + s z, z ~ N(0, 1), where s is their parent's life span. They are moved to that time by the
        parent's mean velocity.
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
