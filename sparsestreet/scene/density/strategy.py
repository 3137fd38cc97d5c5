"""What density control of every kind shares: statistics of rows over steps, and a strategy's interface."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.statistics import add_view_
from sparsestreet.ranks import Ranks
from sparsestreet.scene.gaussians import RowPlan, Rows


class DensityStatistics:
    """Per-row accumulators that density control thresholds; one instance per node.

    >>> statistics = DensityStatistics(rows=2)
    >>> statistics.add(torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([5.0, 0.0]), width=2, height=2)
    >>> statistics.mean_gradients().tolist()
    [5.0, 0.0]
    """

    gradient_sum: Float[Tensor, " n"]
    """Sum of the scaled screen gradient's norm over the visits."""
    visits: Int[Tensor, " n"]
    """Number of views in which the row was drawn."""
    largest_screen: Float[Tensor, " n"]
    """Largest radius on screen as a fraction of the longer image side."""
    watched: dict[str, Float[Tensor, " n"]]
    """Name of a column with one number a row -> sum of its absolute gradient over the visits."""

    def __init__(
        self,
        rows: int,
        device: torch.device | str = "cpu",
        watched: Collection[str] = (),
        *,
        first_counts_all: bool = False,
    ) -> None:
        """``first_counts_all``: whether the first view counts as a visit of rows that it does not draw, as DriveStudio
        has it."""
        self.gradient_sum = torch.zeros(rows, device=device)
        self.visits = torch.zeros(rows, dtype=torch.int64, device=device)
        self.largest_screen = torch.zeros(rows, device=device)
        self.watched = {name: torch.zeros(rows, device=device) for name in watched}
        self.first_counts_all = first_counts_all
        self.is_empty = True

    def __len__(self) -> int:
        return self.visits.shape[0]

    def add(
        self,
        screen_gradient: Float[Tensor, "n 2"],
        radii: Float[Tensor, " n"],
        width: int,
        height: int,
        gradients: Mapping[str, Float[Tensor, " n"]] | None = None,
    ) -> None:
        """Add one view after its backward pass; rows with radius 0 were not drawn and do not change,
        nor do those whose gradient is not finite: they do not step, and have no say here.

        ``screen_gradient`` is the absolute gradient of the loss per pixel of the projected mean
        (``Rendering.screen_offsets.grad``), ``radii`` are pixels, both for this node's rows. As in 3DGS and DriveStudio
        the gradient is scaled to half the image, |(g_x W/2, g_y H/2)|_2, so one threshold fits all image sizes.
        ``gradients`` are those of the watched columns, unscaled. Raises ValueError if the number of rows differs.
        """
        if radii.shape[0] != len(self):
            raise ValueError(
                f"the view has {radii.shape[0]} rows but the statistics have {len(self)}: apply every RowPlan of the "
                "node to its statistics as well"
            )
        add_view_(
            self.gradient_sum, self.visits, self.largest_screen, screen_gradient, radii, (width, height),
            visits_all=self.is_empty and self.first_counts_all,
            watched=[(total, (gradients or {})[name]) for name, total in self.watched.items()],
        )  # fmt: skip
        self.is_empty = False

    def mean_gradients(self, column: str | None = None) -> Float[Tensor, " n"]:
        """Return the mean norm on screen over the visits, or the mean absolute gradient of a watched column.

        Rows that were never drawn have 0. Raises ValueError if a sum is NaN or infinite.
        """
        total = self.gradient_sum if column is None else self.watched[column]
        if not total.isfinite().all():
            row = int((~total.isfinite()).nonzero()[0])
            raise ValueError(
                f"{'screen gradients' if column is None else f'gradients of {column}'} must be finite, but row {row} "
                f"of {len(self)} summed up to {float(total[row])}: the loss of a recent step was not finite"
            )
        return total / self.visits.clamp(min=1)

    def total(self, ranks: Ranks) -> None:
        """Take in what the other processes have seen, so that all decide alike."""
        for values in (self.gradient_sum, self.visits, *self.watched.values()):
            ranks.sum(values)
        ranks.largest(self.largest_screen)

    def absorb(self, other: "DensityStatistics") -> None:
        """Add what other statistics of the same rows have seen."""
        self.gradient_sum, self.visits = self.gradient_sum + other.gradient_sum, self.visits + other.visits
        self.largest_screen = torch.maximum(self.largest_screen, other.largest_screen)
        self.watched = {name: values + other.watched[name] for name, values in self.watched.items()}

    def resize(self, plan: RowPlan) -> None:
        """Apply the plan of the node's rows; fresh rows start at zero."""
        self._each(lambda values: values[plan.source].masked_fill(plan.fresh, 0))

    def reset(self) -> None:
        """Clears all accumulators (after each refinement)."""
        self._each(torch.zeros_like)
        self.is_empty = True

    def to(self, device: torch.device) -> None:
        """Move the accumulators to the device of the rows."""
        self._each(lambda values: values.to(device))

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint; a run resumed between refinements densifies like an uninterrupted one."""
        return vars(self) | {"watched": dict(self.watched)}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> "DensityStatistics":
        """Return the statistics of a checkpoint, with its number of rows."""
        statistics = DensityStatistics(0)
        vars(statistics).update(state)
        statistics._each(torch.clone)
        return statistics

    def _each(self, change: Callable[[Tensor], Tensor]) -> None:
        """Replaces every accumulator."""
        self.gradient_sum = change(self.gradient_sum)
        self.visits = change(self.visits)
        self.largest_screen = change(self.largest_screen)
        self.watched = {name: change(values) for name, values in self.watched.items()}


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
        """Return the plan that clones and splits rows; the table never grows beyond ``max_gaussians``."""
        ...

    def cull(self, rows: Rows, statistics: DensityStatistics, *, radius: float, progress: float) -> RowPlan:
        """Return the plan that drops useless rows."""
        ...

    def reset(self, rows: Rows) -> RowPlan:
        """Return the plan that lowers opacities; needed rows grow back, and the others stay faint."""
        ...

    def noise(self, rows: Rows, rate: float, seed: int) -> Float[Tensor, "n 3"] | None:
        """Return what is added to the means after a step; None: nothing.

        ``rate`` is the means' learning rate of the step, and ``seed`` differs from step to step.
        """
        return None

    def regularizers(self, rows: Rows) -> Mapping[str, Float[Tensor, ""]]:
        """Return terms of the loss that the strategy needs, by name, each with its weight."""
        return {}
