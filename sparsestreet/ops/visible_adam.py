"""One step of Adam for the rows that were seen, in place; all other rows keep their values and moments.

A view draws a part of a scene's rows, but Adam would read and write the moments of all. Taming 3DGS (Mallick et al.
2024) and gsplat's SelectiveAdam step only seen rows; torch.optim.SparseAdam does it for sparse gradients. This is
written from Adam's formula (Kingma & Ba 2015, algorithm 1).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.ops.fused import fused_backend


@dataclass(frozen=True)
class AdamStep:
    """The numbers of one step."""

    count: int
    """Number of this step, from 1, for the whole parameter. So all rows have the bias corrections of a row that was
    seen at every step, as in dense Adam. A row that is first seen late moves by (1 - beta1) / sqrt(1 - beta2) learning
    rates (3.2 with torch's betas), while Adam's first step moves by one."""
    lr: float
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-15

    @property
    def size(self) -> float:
        """The learning rate divided by the first moment's bias correction."""
        return self.lr / (1 - self.betas[0] ** self.count)

    @property
    def root(self) -> float:
        """Square root of the second moment's bias correction."""
        return math.sqrt(1 - self.betas[1] ** self.count)


@torch.no_grad()
def adam_step_(
    parameter: Float[Tensor, "n ..."],
    gradient: Float[Tensor, "n ..."],
    exp_avg: Float[Tensor, "n ..."],
    exp_avg_sq: Float[Tensor, "n ..."],
    visible: Bool[Tensor, " n"],
    step: AdamStep,
    *,
    backend: str = "auto",
) -> None:
    """Updates ``parameter`` and both moments of ``visible`` rows by Adam; other rows keep every bit.

    With all rows visible it is torch.optim.Adam without weight decay. ``backend``: "torch", "triton", or "auto" for
    the one that suits the tensors. Raises as :func:`sparsestreet.ops.fused.fused_backend` does, and ValueError for
    tensors of different shapes.
    """
    check_shapes(parameter, gradient, exp_avg, exp_avg_sq)
    if fused_backend(backend, parameter, exp_avg, exp_avg_sq, choices=("torch", "triton")) == "triton":
        from sparsestreet.ops.triton.adam import step_rows_

        moments = (exp_avg, exp_avg_sq)
        step_rows_(
            parameter, gradient.contiguous(), *moments, visible.contiguous(),
            size=step.size, root=step.root, betas=step.betas, eps=step.eps,
        )  # fmt: skip
        return
    rows = visible.nonzero()[:, 0]
    seen, value = gradient.index_select(0, rows), parameter.index_select(0, rows)
    first = exp_avg.index_select(0, rows).lerp_(seen, 1 - step.betas[0])
    second = exp_avg_sq.index_select(0, rows).mul_(step.betas[1]).addcmul_(seen, seen, value=1 - step.betas[1])
    value.addcdiv_(first, second.sqrt().div_(step.root).add_(step.eps), value=-step.size)
    for whole, part in ((parameter, value), (exp_avg, first), (exp_avg_sq, second)):
        whole.index_copy_(0, rows, part)


def check_shapes(*tensors: Tensor) -> None:
    """Raises ValueError unless a parameter, its gradient and both moments have one shape."""
    shapes = [tuple(tensor.shape) for tensor in tensors]
    if len(set(shapes)) != 1:
        raise ValueError(f"parameter, gradient and moments must have one shape, got {shapes}: resize them together")
