"""The interface of a node's density strategy, which decides where it needs more or fewer Gaussians."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.density.statistics import DensityStatistics
from sparsestreet.scene.gaussians import RowPlan, Rows


@runtime_checkable
class DensityStrategy(Protocol):
    """Pure decisions about one node's rows from their screen statistics; a callback decides when to ask.

    ``radius`` is the scene radius in meters, ``progress`` the fraction of the run.
    """

    watched: ClassVar[Sequence[str]]
    """Names of columns with one number a row whose gradients the statistics must accumulate."""

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
        """Returns the plan that clones and splits rows; the table never grows beyond ``max_gaussians``."""
        ...

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        """Returns the plan that drops useless rows."""
        ...

    def reset(self, rows: Rows) -> RowPlan:
        """Returns the plan that lowers opacities; needed rows grow back, and the others stay faint."""
        ...

    def noise(self, rows: Rows, rate: float, seed: int) -> Float[Tensor, "n 3"] | None:
        """Returns what is added to the means after a step; None: nothing.

        ``rate`` is the means' learning rate of the step, and ``seed`` differs from step to step.
        """
        return None

    def regularizers(self, rows: Rows) -> Mapping[str, Float[Tensor, ""]]:
        """Returns terms of the loss that the strategy needs, by name, each with its weight."""
        return {}
