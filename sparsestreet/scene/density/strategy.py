"""What every density strategy of a node answers: where the scene needs more Gaussians, and where fewer."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch

from sparsestreet.scene.density.statistics import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan, Rows


@runtime_checkable
class DensityStrategy(Protocol):
    """Pure decisions about one node's rows from what its Gaussians did on screen; when to ask is a callback's matter.

    ``radius`` is the scene's, meters; ``progress`` the fraction of the run.
    """

    watched: Sequence[str]
    """Columns with one number a row whose gradients the statistics have to follow."""

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
        """Rows that are cloned and split; the table never grows beyond ``max_gaussians``."""
        ...

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        """Rows that are of no use any more."""
        ...

    def reset(self, rows: Rows) -> RowPlan:
        """Opacities pulled down, so that what is not needed can be told from what grows back."""
        ...
