"""What each Gaussian of a node did on screen since the last refinement."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.scene.gaussians import RowPlan


class DensityStatistics:
    """Per-row accumulators that density control thresholds; one instance per node."""

    gradient_sum: Float[Tensor, " n"]
    """Sum over the visits of the scaled screen gradient's norm."""
    visits: Int[Tensor, " n"]
    """Number of views in which the row was drawn."""
    largest_screen: Float[Tensor, " n"]
    """Largest radius on screen, as a fraction of the longer image side."""
    watched: dict[str, Float[Tensor, " n"]]
    """Name of a column with one number a row -> sum over the visits of its absolute gradient."""

    def __init__(self, rows: int, device: torch.device | str = "cpu", watched: Collection[str] = ()) -> None:
        self.gradient_sum = torch.zeros(rows, device=device)
        self.visits = torch.zeros(rows, dtype=torch.int64, device=device)
        self.largest_screen = torch.zeros(rows, device=device)
        self.watched = {name: torch.zeros(rows, device=device) for name in watched}

    def __len__(self) -> int:
        return self.visits.shape[0]

    @torch.no_grad()
    def add(
        self,
        screen_gradient: Float[Tensor, "n 2"],
        radii: Float[Tensor, " n"],
        width: int,
        height: int,
        gradients: Mapping[str, Float[Tensor, " n"]] | None = None,
    ) -> None:
        """Count one view in, after its backward pass; rows with radius 0 were not drawn and do not change.

        ``screen_gradient``: absolute gradient of the loss per pixel of the projected mean
        (``Rendering.screen_offsets.grad``), ``radii``: pixels, both for this node's rows. As in 3DGS and DriveStudio
        the gradient is taken per half image, |(g_x W/2, g_y H/2)|_2, so that one threshold fits all image sizes.
        ``gradients``: of the watched columns, as they are.
        Raises ValueError if the number of rows differs.
        """
        if radii.shape[0] != len(self):
            raise ValueError(
                f"the view has {radii.shape[0]} rows but the statistics have {len(self)}: apply every RowPlan of the "
                "node to its statistics as well"
            )
        drawn = radii > 0
        norm = torch.hypot(screen_gradient[:, 0] * (width / 2), screen_gradient[:, 1] * (height / 2))
        self.gradient_sum += torch.where(drawn, norm, 0.0)
        self.visits += drawn
        self.largest_screen = torch.maximum(self.largest_screen, radii / max(width, height))
        for name, total in self.watched.items():
            total += torch.where(drawn, gradients[name].abs(), 0.0)

    def mean_gradients(self, column: str | None = None) -> Float[Tensor, " n"]:
        """Mean norm on screen over the visits, or mean absolute gradient of a watched column; 0 for rows never drawn.
        Raises ValueError where it is NaN or infinite."""
        total = self.gradient_sum if column is None else self.watched[column]
        if not total.isfinite().all():
            row = int((~total.isfinite()).nonzero()[0])
            raise ValueError(
                f"{'screen gradients' if column is None else f'gradients of {column}'} must be finite, but row {row} "
                f"of {len(self)} summed up to {float(total[row])}: the loss of a recent step was not finite"
            )
        return total / self.visits.clamp(min=1)

    def resize(self, plan: RowPlan) -> None:
        """Follow the node's rows; fresh ones have seen nothing yet and start at zero."""
        self._each(lambda values: values[plan.source].masked_fill(plan.fresh, 0))

    def reset(self) -> None:
        """Forget all views (after each refinement)."""
        self._each(torch.zeros_like)

    def to(self, device: torch.device) -> None:
        """Move to the device of the rows."""
        self._each(lambda values: values.to(device))

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint: a run resumed between two refinements densifies as the uninterrupted one."""
        return vars(self) | {"watched": dict(self.watched)}

    @staticmethod
    def from_state(state: Mapping[str, Any]) -> "DensityStatistics":
        """Continue from a checkpoint, with as many rows as it has."""
        statistics = DensityStatistics(0)
        vars(statistics).update(state)
        statistics._each(torch.clone)
        return statistics

    def _each(self, change: Callable[[Tensor], Tensor]) -> None:
        """Replace every accumulator."""
        self.gradient_sum = change(self.gradient_sum)
        self.visits = change(self.visits)
        self.largest_screen = change(self.largest_screen)
        self.watched = {name: change(values) for name, values in self.watched.items()}
