"""Step rows of a parameter by Adam, in place: those whose gradient is finite, or those that a view has seen.

Adam would write a NaN into a row's moments, from where it never leaves, so such a row rests. Kernels look at a gradient
that they read anyway, so that this costs no pass over it. A view draws a part of a scene's rows, and Adam would read
and write the moments of all: Taming 3DGS (Mallick et al. 2024) and gsplat's SelectiveAdam step only seen rows. Written
from Adam's formula (Kingma & Ba 2015, algorithm 1).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.autograd.graph import increment_version

from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT


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
    def numbers(self) -> tuple[float, float, float, float, float, float]:
        """Share of the gradient in the first moment; what the second one keeps, and the square's share; then the root
        of its bias correction, epsilon, and the learning rate divided by the first moment's bias correction."""
        first, second = self.betas
        root = math.sqrt(1 - second**self.count)
        return 1 - first, second, 1 - second, root, self.eps, self.lr / (1 - first**self.count)


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
    """Update ``parameter`` and both moments of ``visible`` rows by Adam; other rows keep every bit.

    With all rows visible it is torch.optim.Adam without weight decay. ``backend``: "torch", "triton", or "auto" for
    the one that suits the tensors. Raises as :func:`sparsestreet.ops.backend.fused_backend` does, and ValueError for
    tensors of different shapes.
    """
    check_shapes(parameter, gradient, exp_avg, exp_avg_sq)
    if fused_backend(backend, parameter, exp_avg, exp_avg_sq, choices=("torch", "triton")) == "triton":
        from sparsestreet.ops.triton.adam import step_rows_

        step_rows_(parameter, gradient.contiguous(), exp_avg, exp_avg_sq, visible.contiguous(), step.numbers)
        return
    rows = visible.nonzero()[:, 0]
    share, beta, square_share, root, eps, size = step.numbers
    seen, value = gradient.index_select(0, rows), parameter.index_select(0, rows)
    first = exp_avg.index_select(0, rows).lerp_(seen, share)
    second = exp_avg_sq.index_select(0, rows).mul_(beta).addcmul_(seen, seen, value=square_share)
    value.addcdiv_(first, second.sqrt().div_(root).add_(eps), value=-size)
    for whole, part in ((parameter, value), (exp_avg, first), (exp_avg_sq, second)):
        whole.index_copy_(0, rows, part)


def check_shapes(*tensors: Tensor) -> None:
    """Raise ValueError unless a parameter, its gradient and both moments have one shape."""
    shapes = [tuple(tensor.shape) for tensor in tensors]
    if len(set(shapes)) != 1:
        raise ValueError(f"parameter, gradient and moments must have one shape, got {shapes}: resize them together")


NONE = torch.iinfo(torch.int64).max
"""In place of the first refused row where there is none."""
WIDEST_ROW = 256
"""Numbers of the widest row that steps or rests as one."""


@torch.no_grad()
def adam_all_(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    refused: Int64[Tensor, "parameters 2"],
    steps: Sequence[AdamStep],
    widths: Sequence[int],
    *,
    backend: str = "auto",
) -> None:
    """Update parameters and their moments by Adam; rows whose gradient is not finite keep every bit.

    Where all are finite it is torch.optim.Adam without weight decay. On processors with fused multiplication "cpu" has
    the bits of its ``fused`` form. The library is called once, and a GPU launches one kernel. Nothing waits for a
    device, but for "torch" on a GPU.

    Args:
        parameters: of any shapes, on one device.
        gradients: one a parameter, of its shape.
        first: first moments, of the same shapes.
        second: second moments.
        refused: contiguous, on the same device: of each parameter, the number of such rows is added to the first, and
            the second becomes the number of the first of them, if it is less (``NONE`` stands for none).
        steps: the numbers of the step of each parameter.
        widths: numbers of a row of each, which lie side by side.
        backend: "torch", "cpu", "triton", or "auto" for the one that suits all tensors.

    Raises:
        ValueError: for tensors of different shapes, a width that does not divide them or above WIDEST_ROW, and as
            ``fused_backend`` does.
        RuntimeError: as ``fused_backend`` does.
    """
    tables = list(zip(parameters, gradients, first, second, strict=True))
    for (parameter, *others), width in zip(tables, widths, strict=True):
        check_shapes(parameter, *others)
        if not 1 <= width <= WIDEST_ROW or parameter.numel() % width:
            raise ValueError(f"{parameter.numel()} numbers do not come in rows of {width}, of {WIDEST_ROW} at most")
    written = (*parameters, *first, *second)
    if not written:
        return
    chosen = fused_backend(backend, *written)
    if chosen == "torch" or not all(one.is_contiguous() for one in written):
        for table, counts, step, width in zip(tables, refused, steps, widths, strict=True):
            _in_torch(*table, counts, step, width)
        return
    # They live until the step is on its way.
    gradients = [gradient.contiguous() for gradient in gradients]
    if chosen == "triton":
        from sparsestreet.ops.triton.adam import AdamTables

        stepped = AdamTables(parameters, gradients, first, second, refused, widths)
        stepped.fill([step.numbers for step in steps])
        stepped.launch()
    else:
        _step_in_library_(list(zip(parameters, gradients, first, second, strict=True)), refused, steps, widths)
    # Autograd does not see what is written, but a graph that holds old values must refuse its backward pass.
    increment_version(written)


def _step_in_library_(
    tables: Sequence[tuple[Tensor, ...]], refused: Tensor, steps: Sequence[AdamStep], widths: Sequence[int]
) -> None:
    rows = [
        native.CAdamRows(parameter.numel() // width, width, *native.pointers(parameter, *others), *step.numbers, counts)
        for (parameter, *others), counts, step, width in zip(
            tables, itertools.count(refused.data_ptr(), 2 * refused.element_size()), steps, widths, strict=False
        )
    ]
    native.load_library().splat_adam(
        tables[0][0].dtype == torch.float64, FASTEST_VARIANT, (native.CAdamRows * len(rows))(*rows), len(rows),
        native.thread_count(),
    )  # fmt: skip


def _in_torch(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, refused: Tensor, step: AdamStep, width: int
) -> None:
    if not parameter.numel():
        return
    tables = [values.reshape(-1, width) for values in (parameter, gradient, first, second)]
    finite = finite_rows(tables[1], refused)
    adam_step_(tables[0], tables[1], tables[2], tables[3], finite, step, backend="torch")
    for whole, table in ((parameter, tables[0]), (first, tables[2]), (second, tables[3])):
        if not whole.is_contiguous():
            whole.copy_(table.view(whole.shape))


def finite_rows(gradient: Tensor, refused: Tensor) -> Tensor:
    """Which entries of the first dimension are finite, bool [n]; the others are counted as in ``adam_all_``."""
    # unflatten gives parameters of one number per row a second dimension as well.
    finite = gradient.unflatten(0, (-1, 1)).flatten(1).isfinite().all(1)
    if len(finite):
        numbers = torch.arange(len(finite), device=finite.device).masked_fill(finite, NONE)
        refused[0] += (~finite).sum()
        refused[1] = torch.minimum(refused[1], numbers.min())
    return finite
