"""Adam that leaves a row alone whose gradient is not finite; and one that steps only what the step's view has seen."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.ops.adam import NONE, WIDEST_ROW, AdamStep, adam_all_, adam_step_, finite_rows

Table = tuple[Tensor, Tensor, Tensor, Tensor]
"""A parameter, its gradient, and its moments."""


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
        groups = _in_order_of(self.param_groups, state_dict["param_groups"])
        super().load_state_dict({**state_dict, "param_groups": groups})
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
        counts = torch.zeros(len(held), 2, dtype=torch.int64, device=held[0][0].device if held else "cpu")
        counts[:, 1] = NONE
        self.refused = RefusedRows(tuple(one for one, _ in held), counts)
        if held:
            states = [(one, self._state_of(one)) for one, _ in held]
            tables = [(one, one.grad, state["exp_avg"], state["exp_avg_sq"]) for one, state in states]
            self._update(tables, counts, _steps([state["step"] for _, state in states], [group for _, group in held]))
        return loss

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    def _update(self, tables: Sequence[Table], refused: Tensor, steps: Sequence[AdamStep]) -> None:
        """Step all parameters in place; ``refused``: as in ``adam_all_``."""
        parameters, gradients, first, second = zip(*tables, strict=True)
        adam_all_(parameters, gradients, first, second, refused, steps, [_width(one) for one in parameters])


def _in_order_of(groups: Sequence[dict[str, Any]], saved: Sequence[dict[str, Any]]) -> Sequence[dict[str, Any]]:
    """Return saved groups in the places of those with their rates: torch goes by places alone, and the masks, whose
    groups may hold others too, come before some and go."""
    places = {_rate(group): place for place, group in enumerate(groups)}
    known = len(places) == len(groups) and sorted(places) == sorted(map(_rate, saved))
    return sorted(saved, key=lambda group: places[_rate(group)]) if known else saved


def _rate(group: dict[str, Any]) -> str:
    return repr(sorted(group.get("rate", {}).items()))


def _steps(counts: list[Tensor], groups: Sequence[dict[str, Any]]) -> list[AdamStep]:
    """Count a step of each parameter; its numbers."""
    # One operation for all, and one that reads them.
    torch._foreach_add_(counts, 1)  # pyright: ignore[reportPrivateImportUsage]
    return [
        AdamStep(int(count), group["lr"], tuple(group["betas"]), group["eps"])
        for count, group in zip(torch.stack(counts).tolist(), groups, strict=True)
    ]


def _width(parameter: Tensor) -> int:
    """Numbers of an entry of the first dimension. In one above WIDEST_ROW (a face of the sky) each number is by itself;
    no column of a Gaussian is near it."""
    width = parameter.shape[1:].numel()
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

    def _update(self, tables: Sequence[Table], refused: Tensor, steps: Sequence[AdamStep]) -> None:
        for (parameter, gradient, first, second), counts, step in zip(tables, refused, steps, strict=True):
            seen = seen_rows(gradient) & finite_rows(gradient, counts)
            adam_step_(parameter, gradient, first, second, seen, step)


def seen_rows(gradient: Tensor) -> Tensor:
    """Which entries of the first dimension are not all exactly zero, bool [n]."""
    # unflatten gives parameters of one number per row a second dimension as well.
    return gradient.bool().unflatten(0, (-1, 1)).flatten(1).any(1)
