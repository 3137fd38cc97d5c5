"""Activation and placement of stored rows, and their gradients, one kernel each per part:
``sparsestreet.ops.activate``.

A lane is a row. Gradients of poses are sums over rows. Each program adds up its rows by instance, and torch adds the
programs. Without atomics two runs agree to the last bit.
"""

from collections.abc import Sequence
from functools import partial

import torch
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable
from triton.runtime.jit import KernelInterface

from sparsestreet.ops.raw import OPACITY_LOGIT_LIMIT, Inputs, RawGaussians, split_parts
from sparsestreet.ops.triton.launch import jit, launch
from sparsestreet.ops.triton.quaternions import (
    conjugate,
    load_row,
    multiply,
    plus,
    rotation_backward,
    rotation_of,
    scaled,
    store_row,
    times,
    transposed_times,
    unit_backward,
    unit_quaternion,
    weighted,
)

LANES = 128


def activate(parts: Sequence[RawGaussians]) -> Sequence[Tensor]:
    """Means, quaternions, scales and opacities of ``sparsestreet.ops.activate`` of contiguous float32 tensors."""
    return _Activate.apply(*(tensor for part in parts for tensor in part.tensors()))


class _Activate(torch.autograd.Function):
    """Maps stored rows, multipliers and poses of all parts to means, quaternions, scales and opacities."""

    @staticmethod
    def forward(ctx, *tensors):
        ctx.save_for_backward(*tensors)
        parts = split_parts(tensors)
        outputs = [tensors[0].new_empty(parts[-1][0].stop, *width) for width in ((3,), (4,), (3,), ())]
        for rows, part in parts:
            _launch(activate_rows, rows, part, *outputs)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *cotangents):
        cotangents = [value.contiguous() for value in cotangents]
        gradients = []
        for rows, part in split_parts(ctx.saved_tensors):
            gradients += _part_backward(rows, part, cotangents)
        return tuple(gradients)


def _part_backward(rows: slice, part: Inputs, cotangents: list[Tensor]) -> list[Tensor | None]:
    """Gradients of a part's inputs from those of all rows."""
    means, turns = part[0], part[5]
    gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in part[:5]]
    if turns is None:
        # Means and quaternions passed through unchanged.
        gradients[0] = gradients[2] = None
    # One line per program: four numbers of each instance's quaternion, then three of each translation.
    count = 0 if turns is None else len(turns)
    sums = means if turns is None else means.new_zeros(-(-len(means) // LANES), 7 * count)
    written = [means if value is None else value for value in gradients]
    _launch(activate_rows_backward, rows, part, *cotangents, *written, sums, count)
    if turns is None:
        gradients[0], gradients[2] = cotangents[0][rows], cotangents[1][rows]
        return [*gradients, None, None, None, None]
    v_turns, v_shifts = sums.sum(0).split((4 * count, 3 * count))
    return [*gradients, v_turns.view(-1, 4), v_shifts.view(-1, 3), None, None]


def _launch(kernel: KernelInterface, rows: slice, part: Inputs, *others: Tensor | int) -> None:
    *floats, instances, present = part
    means, placed = floats[0], present is not None
    # Means replace arguments that are not read: multipliers without a mask, and poses without a placement.
    floats = [means if tensor is None else tensor for tensor in floats]
    indices = (instances.contiguous(), present.contiguous().view(torch.uint8)) if placed else (means, means)
    launch(
        kernel, len(means), LANES, *floats, *indices, *others, rows.start, len(means), OPACITY_LOGIT_LIMIT,
        MASKED=part[4] is not None, PLACED=placed,
    )  # fmt: skip


@jit
def opacity_of(logit, limit):
    """Opacity of a limited logit; NaN passes the limits, so that it shows."""
    below = tl.where(logit > limit, limit, logit)
    return 1 / (1 + tl.exp(-tl.where(below < -limit, -limit, below)))


@partial(jit, do_not_specialize=["start", "rows"])
def activate_rows(
    means, log_scales, quaternions, logits, multipliers, turns, shifts, instances, present,
    out_means, out_quaternions, scales, opacities, start, rows, limit,
    MASKED: tl.constexpr, PLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``turns``, ``shifts``: quaternions and translations of the instances; ``start``: the first row to write."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given, to = row < rows, start + row
    mean, q = load_row(means, row, given, 3), load_row(quaternions, row, given, 4)
    log_scale = load_row(log_scales, row, given, 3)
    size = (tl.exp(log_scale[0]), tl.exp(log_scale[1]), tl.exp(log_scale[2]))
    opacity = opacity_of(tl.load(logits + row, given, 0.0), limit)
    if MASKED:
        multiplier = tl.load(multipliers + row, given, 0.0)
        size, opacity = scaled(multiplier, size), opacity * multiplier
    if PLACED:
        instance = tl.load(instances + row, given, 0)
        opacity *= tl.load(present + instance, given, 0).to(tl.float32)
        turn = load_row(turns, instance, given, 4)
        unit, _ = unit_quaternion(turn)
        mean = plus(times(rotation_of(unit), mean), load_row(shifts, instance, given, 3))
        q = multiply(turn, q)
    store_row(out_means, to, mean, given, 3)
    store_row(out_quaternions, to, q, given, 4)
    store_row(scales, to, size, given, 3)
    tl.store(opacities + to, opacity, given)


@partial(jit, do_not_specialize=["count", "start", "rows"])
def activate_rows_backward(
    means, log_scales, quaternions, logits, multipliers, turns, shifts, instances, present,
    v_out_means, v_out_quaternions, v_scales, v_opacities,
    v_means, v_log_scales, v_quaternions, v_logits, v_multipliers, sums, count, start, rows, limit,
    MASKED: tl.constexpr, PLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write gradients; of means, quaternions and poses (``sums`` [programs, 7 count], 0 before) only if PLACED."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given, at = row < rows, start + row
    multiplier = tl.load(multipliers + row, given, 0.0) if MASKED else 1.0
    logit, v_opacity = tl.load(logits + row, given, 0.0), tl.load(v_opacities + at, given, 0.0)
    opacity = opacity_of(logit, limit)
    if PLACED:
        instance = tl.load(instances + row, given, 0)
        v_opacity *= tl.load(present + instance, given, 0).to(tl.float32)
        v_mean, mean = load_row(v_out_means, at, given, 3), load_row(means, row, given, 3)
        v_q, q = load_row(v_out_quaternions, at, given, 4), load_row(quaternions, row, given, 4)
        turn = load_row(turns, instance, given, 4)
        unit, inverse_length = unit_quaternion(turn)
        store_row(v_means, row, transposed_times(rotation_of(unit), v_mean), given, 3)
        store_row(v_quaternions, row, multiply(conjugate(turn), v_q), given, 4)
        v_rotation = (scaled(v_mean[0], mean), scaled(v_mean[1], mean), scaled(v_mean[2], mean))
        through_matrix = unit_backward(unit, inverse_length, rotation_backward(unit, v_rotation))
        v_turn = weighted(1.0, through_matrix, 1.0, multiply(v_q, conjugate(q)))
        to = sums + tl.program_id(0).to(tl.int64) * (7 * count)
        for i in range(tl.min(instance), tl.max(instance) + 1):
            own = given & (instance == i)
            for k in tl.static_range(4):
                tl.store(to + 4 * i + k, tl.sum(tl.where(own, v_turn[k], 0.0)))
            for k in tl.static_range(3):
                tl.store(to + 4 * count + 3 * i + k, tl.sum(tl.where(own, v_mean[k], 0.0)))
    log_scale, v_size = load_row(log_scales, row, given, 3), load_row(v_scales, at, given, 3)
    along = (v_size[0] * tl.exp(log_scale[0]), v_size[1] * tl.exp(log_scale[1]), v_size[2] * tl.exp(log_scale[2]))
    store_row(v_log_scales, row, scaled(multiplier, along), given, 3)
    held = (logit > limit) | (logit < -limit)
    tl.store(v_logits + row, tl.where(held, 0.0, v_opacity * multiplier * opacity * (1 - opacity)), given)
    if MASKED:
        tl.store(v_multipliers + row, v_opacity * opacity + along[0] + along[1] + along[2], given)
