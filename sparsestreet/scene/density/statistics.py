"""What each Gaussian of a node did on screen since the last refinement."""

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

    def __init__(self, rows: int, device: torch.device | str = "cpu") -> None:
        self.gradient_sum = torch.zeros(rows, device=device)
        self.visits = torch.zeros(rows, dtype=torch.int64, device=device)
        self.largest_screen = torch.zeros(rows, device=device)

    def __len__(self) -> int:
        return self.visits.shape[0]

    @torch.no_grad()
    def add(self, screen_gradient: Float[Tensor, "n 2"], radii: Float[Tensor, " n"], width: int, height: int) -> None:
        """Count one view in, after its backward pass; rows with radius 0 were not drawn and do not change.

        ``screen_gradient``: absolute gradient of the loss per pixel of the projected mean
        (``Rendering.screen_offsets.grad``), ``radii``: pixels, both for this node's rows. As in 3DGS and DriveStudio
        the gradient is taken per half image, |(g_x W/2, g_y H/2)|_2, so that one threshold fits all image sizes.
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

    def mean_gradients(self) -> Float[Tensor, " n"]:
        """Mean norm over the visits, 0 for rows never drawn. Raises ValueError where it is NaN or infinite."""
        if not self.gradient_sum.isfinite().all():
            row = int((~self.gradient_sum.isfinite()).nonzero()[0])
            raise ValueError(
                f"screen gradients must be finite, but row {row} of {len(self)} summed up to "
                f"{float(self.gradient_sum[row])}: the loss of a recent step was not finite"
            )
        return self.gradient_sum / self.visits.clamp(min=1)

    def resize(self, plan: RowPlan) -> None:
        """Follow the node's rows; fresh ones have seen nothing yet and start at zero."""
        self.gradient_sum = self.gradient_sum[plan.source].masked_fill(plan.fresh, 0)
        self.visits = self.visits[plan.source].masked_fill(plan.fresh, 0)
        self.largest_screen = self.largest_screen[plan.source].masked_fill(plan.fresh, 0)

    def reset(self) -> None:
        """Forget all views (after each refinement)."""
        self.gradient_sum = torch.zeros_like(self.gradient_sum)
        self.visits = torch.zeros_like(self.visits)
        self.largest_screen = torch.zeros_like(self.largest_screen)

    def state_dict(self) -> dict[str, Tensor]:
        """For a checkpoint: a run resumed between two refinements densifies as the uninterrupted one."""
        return {"gradient_sum": self.gradient_sum, "visits": self.visits, "largest_screen": self.largest_screen}

    def to(self, device: torch.device) -> None:
        """Move to the device of the rows."""
        for name, values in self.state_dict().items():
            setattr(self, name, values.to(device))

    @staticmethod
    def from_state(state: dict[str, Tensor]) -> "DensityStatistics":
        """Continue from a checkpoint, with as many rows as it has."""
        statistics = DensityStatistics(state["visits"].shape[0])
        statistics.gradient_sum = state["gradient_sum"].clone()
        statistics.visits = state["visits"].clone()
        statistics.largest_screen = state["largest_screen"].clone()
        return statistics
