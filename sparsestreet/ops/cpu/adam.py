"""Adam's step by the C++ library, for the rows whose gradient is finite."""

from ctypes import byref

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.workspace import FASTEST_VARIANT


def step_rows_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    refused: Tensor,
    *,
    width: int,
    size: float,
    root: float,
    betas: tuple[float, float],
    eps: float,
    variant: int = FASTEST_VARIANT,
) -> None:
    """``adam.adam_rows_`` on contiguous tensors of one dtype; ``size`` and ``root`` are those of its AdamStep."""
    rows = native.CAdamRows(
        rows=parameter.numel() // width,
        width=width,
        parameter=parameter.data_ptr(),
        gradient=gradient.data_ptr(),
        exp_avg=exp_avg.data_ptr(),
        exp_avg_sq=exp_avg_sq.data_ptr(),
        share=1 - betas[0],
        beta=betas[1],
        square_share=1 - betas[1],
        root=root,
        eps=eps,
        size=size,
        threads=native.thread_count(),
        refused=refused.data_ptr(),
    )
    native.load_library().splat_adam(parameter.dtype == torch.float64, variant, byref(rows))
    # Autograd does not see what the library writes, but a graph that holds old values must refuse its backward pass.
    increment_version((parameter, exp_avg, exp_avg_sq))
