"""One step of Adam, in place, for all rows whose gradient is finite; a row with a NaN or an infinity in it rests.

Adam would write the number into the row's moments, from where it never leaves. Kernels look at a gradient that they
read anyway, so that this costs no pass over it. Written from Adam's formula (Kingma & Ba 2015, algorithm 1).
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from sparsestreet.ops.fused import fused_backend
from sparsestreet.ops.visible_adam import AdamStep, adam_step_, check_shapes

NONE = torch.iinfo(torch.int64).max
"""In place of the first refused row where there is none."""


@torch.no_grad()
def adam_rows_(
    parameter: Float[Tensor, "..."],
    gradient: Float[Tensor, "..."],
    exp_avg: Float[Tensor, "..."],
    exp_avg_sq: Float[Tensor, "..."],
    refused: Int64[Tensor, "2"],
    step: AdamStep,
    *,
    width: int,
    backend: str = "auto",
) -> None:
    """Updates ``parameter`` and both moments by Adam; rows whose gradient is not finite keep every bit.

    Where all are finite it is torch.optim.Adam without weight decay. On processors with fused multiplication "cpu" has
    the bits of its ``fused`` form. Nothing waits for a device, but for "torch" on a GPU.

    Args:
        parameter: of one shape with its gradient and moments.
        refused: on the same device: the number of such rows is added to the first, and the second becomes the number of
            the first of them, if it is less (``NONE`` stands for none).
        step: the numbers of the step.
        width: numbers of a row, which lie side by side.
        backend: "torch", "cpu", "triton", or "auto" for the one that suits the tensors.

    Raises:
        ValueError: for tensors of different shapes, a width that does not divide them, and as ``fused_backend`` does.
        RuntimeError: as ``fused_backend`` does.
    """
    check_shapes(parameter, gradient, exp_avg, exp_avg_sq)
    if not parameter.numel():
        return
    if width < 1 or parameter.numel() % width:
        raise ValueError(f"{parameter.numel()} numbers do not come in rows of {width}")
    chosen = fused_backend(backend, parameter, exp_avg, exp_avg_sq)
    if chosen == "torch" or not all(one.is_contiguous() for one in (parameter, exp_avg, exp_avg_sq)):
        _in_torch(parameter, gradient, exp_avg, exp_avg_sq, refused, step, width)
        return
    if chosen == "cpu":
        from sparsestreet.ops.cpu.adam import step_rows_
    else:
        from sparsestreet.ops.triton.adam import step_finite_rows_ as step_rows_
    step_rows_(
        parameter, gradient.contiguous(), exp_avg, exp_avg_sq, refused,
        width=width, size=step.size, root=step.root, betas=step.betas, eps=step.eps,
    )  # fmt: skip


def _in_torch(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, refused: Tensor, step: AdamStep, width: int
) -> None:
    tables = [values.reshape(-1, width) for values in (parameter, gradient, first, second)]
    finite = finite_rows(tables[1], refused)
    adam_step_(tables[0], tables[1], tables[2], tables[3], finite, step, backend="torch")
    for whole, table in ((parameter, tables[0]), (first, tables[2]), (second, tables[3])):
        if not whole.is_contiguous():
            whole.copy_(table.view(whole.shape))


def finite_rows(gradient: Tensor, refused: Tensor) -> Tensor:
    """Which entries of the first dimension are finite, bool [n]; the others are counted as in ``adam_rows_``."""
    # unflatten gives parameters of one number per row a second dimension as well.
    finite = gradient.unflatten(0, (-1, 1)).flatten(1).isfinite().all(1)
    if len(finite):
        numbers = torch.arange(len(finite), device=finite.device).masked_fill(finite, NONE)
        refused[0] += (~finite).sum()
        refused[1] = torch.minimum(refused[1], numbers.min())
    return finite
