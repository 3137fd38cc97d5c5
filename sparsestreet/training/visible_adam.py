"""Adam that steps only what the step's view has seen."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from sparsestreet.ops.adam import finite_rows
from sparsestreet.ops.visible_adam import AdamStep, adam_step_
from sparsestreet.training.row_adam import RefusedRows


class VisibleAdam(Optimizer):
    """torch.optim.Adam whose update leaves a row alone, moments included, where its gradient is exactly zero.

    A row is an entry of a parameter's first dimension: a Gaussian, of the sky a face, of the poses an object. The splat
    op writes exactly zero for rows that were not drawn, so that the gradient itself says what was seen and no list of
    rows needs to reach the optimizer. It says so per parameter: where a regularizer gives every mask logit a gradient,
    every mask logit steps as in Adam, while the means of the same hidden rows rest. A row that was drawn but hidden by
    others to the last bit rests as well. A row whose gradient is not finite does not step
    either, and is counted (``RowAdam``); to look for such rows takes this optimizer a pass over the gradients.

    State as torch.optim.Adam keeps it (step, exp_avg, exp_avg_sq), so that it can go on from Adam's checkpoint.
    ``step`` counts the steps at which the parameter had a gradient at all (see AdamStep.count).
    """

    def __init__(
        self, params: Any, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        self.refused: RefusedRows | None = None

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step; answers what ``closure``, which recomputes the gradients, answers."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        self.refused = RefusedRows.of(self.param_groups)
        for parameter, gradient, group, refused in self.refused.places():
            self._update(parameter, gradient, group, refused)
        return loss

    def _update(self, parameter: Tensor, gradient: Tensor, group: Mapping[str, Any], refused: Tensor) -> None:
        state = self.state[parameter]
        if not state:
            # On the host, where the bias corrections are computed, as an unfused Adam has it.
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        state["step"] += 1
        step = AdamStep(int(state["step"]), group["lr"], tuple(group["betas"]), group["eps"])
        steps = seen_rows(gradient) & finite_rows(gradient, refused)
        adam_step_(parameter, gradient, state["exp_avg"], state["exp_avg_sq"], steps, step)


def seen_rows(gradient: Tensor) -> Tensor:
    """Which entries of the first dimension are not all exactly zero, bool [n]."""
    # unflatten gives parameters of one number per row a second dimension as well.
    return gradient.bool().unflatten(0, (-1, 1)).flatten(1).any(1)
