"""Adam for the rows that were seen, one lane per number; for other rows only the mask is read."""

from functools import partial

import triton.language as tl
from torch import Tensor, uint8
from torch.autograd.graph import increment_version

from sparsestreet.ops.triton.language import jit
from sparsestreet.ops.triton.launch import launch

# One number per lane: whether a lane loads differs between neighbors, so that wider loads would not be merged.
LANES = 256
OPTIONS = {"num_warps": 8}


def step_rows_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    visible: Tensor,
    *,
    size: float,
    root: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """``visible_adam.adam_step_`` on contiguous float32 tensors; ``size`` and ``root`` are those of its AdamStep."""
    numbers = parameter.numel()
    if not numbers:
        return
    launch(
        step_numbers, numbers, LANES,
        parameter, gradient, exp_avg, exp_avg_sq, visible.view(uint8), numbers,
        1 - betas[0], betas[1], 1 - betas[1], root, eps, size,
        ROW=numbers // len(parameter), options=OPTIONS,
    )  # fmt: skip
    # Autograd does not see what a kernel writes, but a graph that holds old values must refuse its backward pass.
    increment_version((parameter, exp_avg, exp_avg_sq))


@partial(jit, do_not_specialize=["numbers"])
def step_numbers(
    parameter, gradient, exp_avg, exp_avg_sq, visible, numbers,
    share, beta, square_share, root, eps, size,
    ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``share`` and ``square_share``: one minus the decay of the first and of the second moment, ``beta``."""
    first = tl.program_id(0).to(tl.int64) * BLOCK
    lane = tl.arange(0, BLOCK)
    # A division in 64 bits for the program, in 32 for the lanes.
    row = first // ROW + ((first % ROW).to(tl.int32) + lane) // ROW
    at = first + lane
    given = at < numbers
    seen = given & (tl.load(visible + row, given, 0) != 0)
    g = tl.load(gradient + at, seen, 0.0)
    m, v = tl.load(exp_avg + at, seen, 0.0), tl.load(exp_avg_sq + at, seen, 0.0)
    m += share * (g - m)
    v = beta * v + square_share * g * g
    # Rounded as torch rounds. The kernel waits for memory anyway; approximate operations would differ by two units.
    change = size * tl.div_rn(m, tl.div_rn(tl.sqrt_rn(v), root + tl.zeros_like(v)) + eps)
    tl.store(parameter + at, tl.load(parameter + at, seen, 0.0) - change, seen)
    tl.store(exp_avg + at, m, seen)
    tl.store(exp_avg_sq + at, v, seen)
