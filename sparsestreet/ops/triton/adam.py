"""Adam for the rows that were seen, one lane per number; for other rows only the mask is read. And Adam for the rows
whose gradient is finite, of all parameters in one launch."""

from collections.abc import Sequence
from functools import partial

import torch
import triton
import triton.language as tl
from torch import Tensor, uint8
from torch.autograd.graph import increment_version

from sparsestreet.ops.triton.launch import constant, jit, launch

# One number per lane: whether a lane loads differs between neighbors, so that wider loads would not be merged.
LANES = 256
OPTIONS = {"num_warps": 8}


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


WIDE = 4
"""Numbers of the 16 bytes that a lane reads at once: a program begins at a multiple of them."""
FIELDS = 7
"""Of a parameter: addresses of itself, its gradient and moments; its numbers, those of a row, its first program."""
RATES = 6
"""Numbers of an AdamStep."""
PROGRAM = 1024
"""Most numbers that a program steps; so that rows of up to 256 numbers begin at multiples of 16 bytes."""
MIN_PLACES = 32
_FIELDS, _RATES, _WIDE = constant(FIELDS), constant(RATES), constant(WIDE)


class AdamTables:
    """Parameters, their gradients and moments as the tables that one launch reads.

    ``fill`` and ``launch`` step them. No argument of the launch depends on the step: recorded once with its copy, it is
    played back after another ``fill``, of the same memory of the host; the copy before must have ended by then.

    ``host`` is that memory, pinned where it is a GPU's, and ``launch`` copies it first.

    Args:
        parameters: contiguous float32 tensors of one device, as their gradients and moments are. Addresses are kept:
            who launches again keeps the tensors.
        gradients: one a parameter.
        first: first moments.
        second: second moments.
        refused: int64 [parameters, 2], as in ``adam.adam_all_``.
        widths: numbers of a row of each parameter, 256 at most.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        gradients: Sequence[Tensor],
        first: Sequence[Tensor],
        second: Sequence[Tensor],
        refused: Tensor,
        widths: Sequence[int],
    ) -> None:
        self._refused, self._programs, fields = refused, 0, []
        for *tensors, width in zip(parameters, gradients, first, second, widths, strict=True):
            numbers = tensors[0].numel()
            fields.append([*(one.data_ptr() for one in tensors), numbers, width, self._programs])
            self._programs += -(-numbers // numbers_of_program(width))
        # Places that are left over begin behind the last program.
        self._places = triton.next_power_of_2(max(len(fields), MIN_PLACES))
        fields += [[0] * (FIELDS - 1) + [self._programs]] * (self._places - len(fields))
        self._aligned = not any(address % (4 * WIDE) for field in fields for address in field[:4])
        # One copy: an int64 holds two numbers of a step.
        on_gpu = refused.is_cuda
        self.host = torch.empty(FIELDS + RATES // 2, self._places, dtype=torch.int64, pin_memory=on_gpu)
        self.host[:FIELDS] = torch.tensor(fields, dtype=torch.int64).T
        self._rates = self.host[FIELDS:].view(torch.float32).view(RATES, self._places)
        self._table = torch.empty_like(self.host, device=refused.device)

    def fill(self, steps: Sequence[Sequence[float]]) -> None:
        """Write the numbers of each parameter's AdamStep; on the host alone."""
        self._rates[:, : len(steps)] = torch.tensor(steps).T

    def launch(self) -> None:
        """Copy the tables to the device and step all parameters."""
        self._table.copy_(self.host, non_blocking=True)
        launch(
            step_tables, self._programs * PROGRAM, PROGRAM,
            self._table, self._table.view(torch.float32), self._refused,
            PLACES=self._places, ALIGNED=self._aligned, options=OPTIONS,
        )  # fmt: skip


def numbers_of_program(width: int) -> int:
    """Return how many numbers a program steps: whole rows, and a multiple of WIDE."""
    return PROGRAM // (WIDE * width) * (WIDE * width)


@jit
def place_of(table, rates, PLACES: tl.constexpr, BLOCK: tl.constexpr):
    """Return where a program's parameter stands in the table, the numbers of its step, which parameter it is, the first
    number of the program, how many there are, and how many make a row."""
    program = tl.program_id(0)
    begins = tl.load(table + (_FIELDS - 1) * PLACES + tl.arange(0, PLACES))
    place = tl.sum((begins <= program).to(tl.int32), 0) - 1
    field = table + place
    width = tl.load(field + (_FIELDS - 2) * PLACES).to(tl.int32)
    # That all are multiples of four is seen by the compiler.
    size = BLOCK // (_WIDE * width) * width * _WIDE
    start = (program - tl.load(field + (_FIELDS - 1) * PLACES)) * size
    left = tl.minimum(tl.load(field + (_FIELDS - 3) * PLACES) - start, size).to(tl.int32)
    numbers = ()
    for i in tl.static_range(_RATES):
        numbers += (tl.load(rates + (2 * _FIELDS + i) * PLACES + place),)
    return field, numbers, place, start, left, width


@jit
def pointer(address, start, ALIGNED: tl.constexpr):
    """Return a pointer to a tensor's number ``start``."""
    first = tl.load(address).to(tl.pointer_type(tl.float32))
    if ALIGNED:
        first = tl.multiple_of(first, 16)
    return first + start


@jit
def not_finite(g):
    """1 where a number is NaN, which compares as false, or infinite."""
    return tl.where(tl.abs(g) < float("inf"), 0, 1)


@jit
def step_given(p, m, v, g, values, first, second, given, rates):
    first, second, change = stepped(g, first, second, rates[0], rates[1], rates[2], rates[3], rates[4], rates[5])
    tl.store(p, values - change, given)
    tl.store(m, first, given)
    tl.store(v, second, given)


@jit
def step_tables(table, rates, refused, PLACES: tl.constexpr, ALIGNED: tl.constexpr, BLOCK: tl.constexpr):
    """Whole rows of one parameter. ``table`` int64 [FIELDS, PLACES], and behind it ``rates`` float32 [RATES, PLACES],
    of the same memory; ``refused`` int64 [PLACES, 2]: how many rows were not finite, and the first of them."""
    field, rates, place, start, left, width = place_of(table, rates, PLACES, BLOCK)
    lane = tl.arange(0, BLOCK)
    p = pointer(field, start, ALIGNED) + lane
    g = pointer(field + PLACES, start, ALIGNED) + lane
    m = pointer(field + 2 * PLACES, start, ALIGNED) + lane
    v = pointer(field + 3 * PLACES, start, ALIGNED) + lane
    wrong = 1
    if left % _WIDE == 0:
        given = lane < left // _WIDE * _WIDE
        # Nearly always all rows step: all is read at once, before the gradient is looked at.
        gradient, values = tl.load(g, given, 0.0), tl.load(p, given, 0.0)
        first, second = tl.load(m, given, 0.0), tl.load(v, given, 0.0)
        wrong = tl.max(not_finite(gradient), 0)
        if wrong == 0:
            step_given(p, m, v, gradient, values, first, second, given, rates)
    # A parameter's last numbers, and rows of which some rest.
    if wrong > 0:
        row = lane // width
        given = lane < left
        bad = tl.zeros_like(lane)
        for column in range(width):
            # From the cache.
            bad |= not_finite(tl.load(g - lane + row * width + column, given, 0.0))
        seen = given & (bad == 0)
        gradient, values = tl.load(g, seen, 0.0), tl.load(p, seen, 0.0)
        first, second = tl.load(m, seen, 0.0), tl.load(v, seen, 0.0)
        step_given(p, m, v, gradient, values, first, second, seen, rates)
        count = tl.sum(tl.where(row * width == lane, bad, 0), 0)
        if count > 0:
            tl.atomic_add(refused + 2 * place, count.to(tl.int64))
            number = tl.where(bad > 0, start // width + row, 9223372036854775807)
            tl.atomic_min(refused + 2 * place + 1, tl.min(number, 0))
