"""A density strategy of one's own: it says how many Gaussians a pass may add."""

from dataclasses import dataclass

import torch

from sparsestreet.scene.density import DensityStatistics, GradientDensity
from sparsestreet.scene.gaussians import RowPlan, Rows


@dataclass(frozen=True)
class GrowthDensity(GradientDensity):
    """As GradientDensity, but a pass adds this fraction of the Gaussians at most."""

    growth: float = 0.1

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
        limit = len(rows) + int(self.growth * len(rows))
        most = limit if max_gaussians is None else min(limit, max_gaussians)
        return super().densify(
            rows, statistics, radius=radius, progress=progress, max_gaussians=most, generator=generator
        )
