"""Adam that leaves a row alone whose gradient is not finite; and one that steps only what the step's view has seen."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.ops.adam import NONE, AdamStep, adam_rows_, adam_step_, finite_rows

WIDEST_ROW = 256
"""Numbers of the widest row that steps or rests as one. In wider ones (a face of the sky) each number is by itself;
no column of a Gaussian is near it."""


@dataclass(frozen=True)
class RefusedRows:
    """What a step refused: of each parameter with a gradient the number of rows, and the first of them."""

    parameters: tuple[Tensor, ...]
    counts: Tensor
    """int64 [parameters, 2], on the device of the parameters."""


class RowAdam(torch.optim.Adam):
    """torch.optim.Adam, but for rows whose gradient holds a NaN or an infinity: their values and moments rest.

    A row is an entry of a parameter's first dimension. ``refused`` says what the last step left alone; it lies on the
    device, and reading it waits. State is kept as torch.optim.Adam keeps it, so that checkpoints fit both; ``step`` is
    on the host, where the bias corrections are computed. On the CPU with the C++ library the bits are those of torch's
    fused Adam; on a GPU Triton's differ from them by rounding.
    """

    def __init__(
        self, params: Any, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15
    ) -> None:
        super().__init__(params, lr=lr, betas=betas, eps=eps)
        self.refused: RefusedRows | None = None

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        for group in self.param_groups:
            group["fused"] = None  # of older checkpoints; torch then keeps steps on the device
        for state in self.state.values():
            state["step"] = state["step"].cpu()

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step; answers what ``closure``, which recomputes the gradients, answers."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        held = [(one, group) for group in self.param_groups for one in group["params"] if one.grad is not None]
        device = held[0][0].device if held else torch.device("cpu")
        counts = torch.zeros(len(held), 2, dtype=torch.int64, device=device)
        counts[:, 1] = NONE
        self.refused = RefusedRows(tuple(one for one, _ in held), counts)
        for (parameter, group), refused in zip(held, counts, strict=True):
            state = self.state[parameter]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            state["step"] += 1
            step = AdamStep(int(state["step"]), group["lr"], tuple(group["betas"]), group["eps"])
            self._update(parameter, parameter.grad, (state["exp_avg"], state["exp_avg_sq"]), refused, step)
        return loss

    def _update(
        self, parameter: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], refused: Tensor, step: AdamStep
    ) -> None:
        """One parameter's step in place; ``refused``: as in ``adam_rows_``."""
        adam_rows_(parameter, gradient, *moments, refused, step, width=_width(parameter))


def _width(parameter: Tensor) -> int:
    width = parameter[0].numel() if parameter.dim() and len(parameter) else 1
    return width if 0 < width <= WIDEST_ROW else 1


class VisibleAdam(RowAdam):
    """RowAdam whose update leaves a row alone too, moments included, where its gradient is exactly zero.

    A row is an entry of a parameter's first dimension: a Gaussian, of the sky a face, of the poses an object. The splat
    op writes exactly zero for rows that were not drawn, so that the gradient itself says what was seen and no list of
    rows needs to reach the optimizer. It says so per parameter: where a regularizer gives every mask logit a gradient,
    every mask logit steps as in Adam, while the means of the same hidden rows rest. A row that was drawn but hidden by
    others to the last bit rests as well. To look for gradients that are not finite takes this optimizer a pass over
    them.

    ``step`` counts the steps at which the parameter had a gradient at all (see AdamStep.count).
    """

    def _update(
        self, parameter: Tensor, gradient: Tensor, moments: tuple[Tensor, Tensor], refused: Tensor, step: AdamStep
    ) -> None:
        steps = seen_rows(gradient) & finite_rows(gradient, refused)
        adam_step_(parameter, gradient, *moments, steps, step)


def seen_rows(gradient: Tensor) -> Tensor:
    """Which entries of the first dimension are not all exactly zero, bool [n]."""
    # unflatten gives parameters of one number per row a second dimension as well.
    return gradient.bool().unflatten(0, (-1, 1)).flatten(1).any(1)
