"""Adam for the rows that were seen, one lane per number; for other rows only the mask is read. And Adam for the rows
whose gradient is finite, which a program reads whole."""

from functools import partial

import triton
import triton.language as tl
from torch import Tensor, uint8
from torch.autograd.graph import increment_version

from sparsestreet.ops.triton.launch import jit, launch

# One number per lane: whether a lane loads differs between neighbors, so that wider loads would not be merged.
LANES = 256
OPTIONS = {"num_warps": 8}
TABLE = 512
"""Numbers of whole rows, padded to a power of two, that a program steps."""


def step_rows_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    visible: Tensor,
    step: tuple[float, ...],
) -> None:
    """``adam.adam_step_`` on contiguous float32 tensors; ``step``: the numbers of its AdamStep."""
    numbers = parameter.numel()
    if not numbers:
        return
    launch(
        step_numbers, numbers, LANES,
        parameter, gradient, exp_avg, exp_avg_sq, visible.view(uint8), numbers, *step,
        ROW=numbers // len(parameter), options=OPTIONS,
    )  # fmt: skip
    # Autograd does not see what a kernel writes, but a graph that holds old values must refuse its backward pass.
    increment_version((parameter, exp_avg, exp_avg_sq))


@jit
def stepped(g, m, v, share, beta, square_share, root, eps, size):
    """Both moments after a gradient, and what the parameter loses. ``share`` and ``square_share``: one minus the decay
    of the first and of the second moment, ``beta``."""
    m += share * (g - m)
    v = beta * v + square_share * g * g
    # Rounded as torch rounds. The kernel waits for memory anyway; approximate operations would differ by two units.
    return m, v, size * tl.div_rn(m, tl.div_rn(tl.sqrt_rn(v), root + tl.zeros_like(v)) + eps)


@partial(jit, do_not_specialize=["numbers"])
def step_numbers(
    parameter, gradient, exp_avg, exp_avg_sq, visible, numbers,
    share, beta, square_share, root, eps, size,
    ROW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Rows of ROW numbers that are ``visible``."""
    first = tl.program_id(0).to(tl.int64) * BLOCK
    lane = tl.arange(0, BLOCK)
    # A division in 64 bits for the program, in 32 for the lanes.
    row = first // ROW + ((first % ROW).to(tl.int32) + lane) // ROW
    at = first + lane
    given = at < numbers
    seen = given & (tl.load(visible + row, given, 0) != 0)
    g = tl.load(gradient + at, seen, 0.0)
    m, v = tl.load(exp_avg + at, seen, 0.0), tl.load(exp_avg_sq + at, seen, 0.0)
    m, v, change = stepped(g, m, v, share, beta, square_share, root, eps, size)
    tl.store(parameter + at, tl.load(parameter + at, seen, 0.0) - change, seen)
    tl.store(exp_avg + at, m, seen)
    tl.store(exp_avg_sq + at, v, seen)


def step_finite_rows_(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    refused: Tensor,
    width: int,
    step: tuple[float, ...],
) -> None:
    """``adam.adam_rows_`` on contiguous float32 tensors; ``step``: the numbers of its AdamStep."""
    rows, padded = parameter.numel() // width, triton.next_power_of_2(width)
    launch(
        step_finite_rows, rows, max(TABLE // padded, 1),
        parameter, gradient, exp_avg, exp_avg_sq, refused, rows, *step,
        WIDTH=width, PADDED=padded, options=OPTIONS,
    )  # fmt: skip
    increment_version((parameter, exp_avg, exp_avg_sq))


@partial(jit, do_not_specialize=["rows"])
def step_finite_rows(
    parameter, gradient, exp_avg, exp_avg_sq, refused, rows,
    share, beta, square_share, root, eps, size,
    WIDTH: tl.constexpr, PADDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """BLOCK rows of WIDTH numbers; ``refused``: how many were not finite, and the first of them."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, PADDED)
    at = row[:, None] * WIDTH + column[None, :]
    given = (row < rows)[:, None] & (column < WIDTH)[None, :]
    g = tl.load(gradient + at, given, 0.0)
    # NaN compares as false.
    wrong = tl.max(tl.where(tl.abs(g) < float("inf"), 0, 1), 1)
    seen = given & (wrong == 0)[:, None]
    m, v = tl.load(exp_avg + at, seen, 0.0), tl.load(exp_avg_sq + at, seen, 0.0)
    g = tl.where(seen, g, 0.0)
    m, v, change = stepped(g, m, v, share, beta, square_share, root, eps, size)
    tl.store(parameter + at, tl.load(parameter + at, seen, 0.0) - change, seen)
    tl.store(exp_avg + at, m, seen)
    tl.store(exp_avg_sq + at, v, seen)
    count = tl.sum(wrong, 0)
    if count > 0:
        tl.atomic_add(refused, count.to(tl.int64))
        tl.atomic_min(refused + 1, tl.min(tl.where(wrong > 0, row, 9223372036854775807), 0))
