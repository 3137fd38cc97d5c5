"""Activation and placement of stored rows and their gradients, one kernel each: ``sparsestreet.ops.activate``.

A lane is a row; coefficients are copied in tiles of rows and columns, so that neighbors read and write neighbors.
Gradients of poses are sums over rows: each program adds up its own, instance by instance, and torch adds the programs'.
No atomics: two runs agree to the last bit.
"""

from functools import partial

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.activate import Placement, RawGaussians
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.quaternions import (
    conjugate,
    multiply,
    rotation_backward,
    rotation_of,
    unit_backward,
    unit_quaternion,
)
from sparsestreet.ops.triton.vectors import load_row, plus, scaled, store_row, times, transposed_times
from sparsestreet.types import Gaussians

LANES = 128
COLUMNS = constant(16)
"""Numbers of a row that are copied at once."""


def activate(
    raw: RawGaussians,
    terms: int,
    multipliers: Float[Tensor, " n"] | None,
    placement: Placement | None,
    logit_limit: float,
) -> Gaussians:
    """``sparsestreet.ops.activate`` of contiguous float32 tensors, with so many coefficients."""
    poses = (None,) * 4
    if placement is not None:
        at = placement.poses
        poses = (at.quaternions, at.translations, placement.instances.contiguous(), at.present.contiguous())
    scales, opacities, sh, *placed = _Activate.apply(*vars(raw).values(), multipliers, *poses, terms, logit_limit)
    means, quaternions = placed if placement is not None else (raw.means, raw.quaternions)
    return Gaussians(means, quaternions, scales, opacities, sh)


class _Activate(torch.autograd.Function):
    """Stored rows, multipliers and poses to scales, opacities, coefficients and, with poses, means and quaternions."""

    @staticmethod
    def forward(ctx, *given):
        *tensors, terms, logit_limit = given
        means, quaternions = tensors[0], tensors[2]
        outputs = [torch.empty_like(means), means.new_empty(len(means)), means.new_empty(len(means), terms, 3)]
        placed = [torch.empty_like(means), torch.empty_like(quaternions)] if tensors[7] is not None else []
        ctx.save_for_backward(*tensors)
        ctx.terms, ctx.logit_limit = terms, logit_limit
        _launch(activate_rows, ctx, tensors, *outputs, *(placed or (means, quaternions)))
        return *outputs, *placed

    @staticmethod
    @once_differentiable
    def backward(ctx, *cotangents):
        tensors = list(ctx.saved_tensors)
        means, turns = tensors[0], tensors[7]
        placed, count = turns is not None, 0 if turns is None else len(turns)
        gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in tensors[:7]]
        # Means and quaternions that are not placed did not come through here.
        if not placed:
            gradients[0] = gradients[2] = None
        # As in torch: an optimizer leaves alone what has no part in the image yet.
        if ctx.terms == 1:
            gradients[5] = None
        # A line for each program: four numbers of each instance's quaternion, then three of each translation.
        sums = means.new_zeros(-(-len(means) // LANES), 7 * count) if placed else means
        _launch(
            activate_rows_backward, ctx, tensors,
            *(value.contiguous() for value in cotangents), *(() if placed else (means, means)),
            *(means if value is None else value for value in gradients), sums, count,
        )  # fmt: skip
        if placed:
            turn, shift = sums.sum(0).split((4 * count, 3 * count))
            gradients += [turn.view(-1, 4), shift.view(-1, 3)]
        return *gradients, *(None,) * (len(tensors) + 2 - len(gradients))


def _launch(kernel, ctx, tensors: list[Tensor | None], *others: Tensor | int) -> None:
    """Start a kernel on the six fields, multipliers, pose quaternions and translations, instances, presence."""
    *floats, instances, present = tensors
    means, placed = tensors[0], present is not None
    # Means stand for what is not read: multipliers without a mask, all that is about poses without a placement.
    floats = [means if tensor is None else tensor for tensor in floats]
    indices = (instances, present.view(torch.uint8)) if placed else (means, means)
    launch(
        kernel, len(means), LANES, *floats, *indices, *others, len(means), ctx.logit_limit,
        TERMS=ctx.terms, STORED=1 + tensors[5].shape[1], MASKED=tensors[6] is not None, PLACED=placed,
    )  # fmt: skip


@jit
def opacity_of(logit, limit):
    """NaN passes the limits, so that it shows."""
    below = tl.where(logit > limit, limit, logit)
    return 1 / (1 + tl.exp(-tl.where(below < -limit, -limit, below)))


@jit
def tile(row, given, COLUMN: tl.constexpr, WIDTH: tl.constexpr):
    """Rows, the columns from COLUMN, which of them are the first coefficient's, and which the others' up to WIDTH."""
    column = COLUMN + tl.arange(0, COLUMNS)[None, :]
    return row[:, None], column, given[:, None] & (column < 3), given[:, None] & (column >= 3) & (column < WIDTH)


@partial(jit, do_not_specialize=["rows"])
def activate_rows(
    means, log_scales, quaternions, logits, dc, rest, multipliers, turns, shifts, instances, present,
    scales, opacities, sh, placed_means, placed_quaternions, rows, limit,
    TERMS: tl.constexpr, STORED: tl.constexpr, MASKED: tl.constexpr, PLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``turns``, ``shifts``: quaternions and translations of the instances; STORED: coefficients of a row."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
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
        mean = times(rotation_of(unit), load_row(means, row, given, 3))
        store_row(placed_means, row, plus(mean, load_row(shifts, instance, given, 3)), given, 3)
        store_row(placed_quaternions, row, multiply(turn, load_row(quaternions, row, given, 4)), given, 4)
    store_row(scales, row, size, given, 3)
    tl.store(opacities + row, opacity, given)
    for first in tl.static_range(0, 3 * TERMS, COLUMNS):
        of, column, begins, follows = tile(row, given, first, 3 * TERMS)
        to = sh + of * (3 * TERMS) + column
        tl.store(to, tl.load(dc + of * 3 + column, begins), begins)
        tl.store(to, tl.load(rest + of * (3 * STORED - 3) + column - 3, follows), follows)


@partial(jit, do_not_specialize=["rows"])
def activate_rows_backward(
    means, log_scales, quaternions, logits, dc, rest, multipliers, turns, shifts, instances, present,
    v_scales, v_opacities, v_sh, v_placed_means, v_placed_quaternions,
    v_means, v_log_scales, v_quaternions, v_logits, v_dc, v_rest, v_multipliers, sums, count, rows, limit,
    TERMS: tl.constexpr, STORED: tl.constexpr, MASKED: tl.constexpr, PLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``sums`` [programs, 7 count] are 0 before: the gradients of the poses of ``count`` instances."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = row < rows
    multiplier = tl.load(multipliers + row, given, 0.0) if MASKED else 1.0
    logit, v_opacity = tl.load(logits + row, given, 0.0), tl.load(v_opacities + row, given, 0.0)
    opacity = opacity_of(logit, limit)
    if PLACED:
        instance = tl.load(instances + row, given, 0)
        v_opacity *= tl.load(present + instance, given, 0).to(tl.float32)
        v_mean, mean = load_row(v_placed_means, row, given, 3), load_row(means, row, given, 3)
        turn, q = load_row(turns, instance, given, 4), load_row(quaternions, row, given, 4)
        v_q = load_row(v_placed_quaternions, row, given, 4)
        unit, inverse_length = unit_quaternion(turn)
        store_row(v_means, row, transposed_times(rotation_of(unit), v_mean), given, 3)
        store_row(v_quaternions, row, multiply(conjugate(turn), v_q), given, 4)
        v_rotation = (scaled(v_mean[0], mean), scaled(v_mean[1], mean), scaled(v_mean[2], mean))
        through_matrix = unit_backward(unit, inverse_length, rotation_backward(unit, v_rotation))
        through_product = multiply(v_q, conjugate(q))
        to = sums + tl.program_id(0).to(tl.int64) * (7 * count)
        for i in range(tl.min(instance), tl.max(instance) + 1):
            own = given & (instance == i)
            for k in tl.static_range(4):
                tl.store(to + 4 * i + k, tl.sum(tl.where(own, through_matrix[k] + through_product[k], 0.0)))
            for k in tl.static_range(3):
                tl.store(to + 4 * count + 3 * i + k, tl.sum(tl.where(own, v_mean[k], 0.0)))
    log_scale, v_size = load_row(log_scales, row, given, 3), load_row(v_scales, row, given, 3)
    along = (v_size[0] * tl.exp(log_scale[0]), v_size[1] * tl.exp(log_scale[1]), v_size[2] * tl.exp(log_scale[2]))
    store_row(v_log_scales, row, scaled(multiplier, along), given, 3)
    held = (logit > limit) | (logit < -limit)
    tl.store(v_logits + row, tl.where(held, 0.0, v_opacity * multiplier * opacity * (1 - opacity)), given)
    if MASKED:
        tl.store(v_multipliers + row, v_opacity * opacity + along[0] + along[1] + along[2], given)
    for first in tl.static_range(0, 3 * STORED if TERMS > 1 else 3, COLUMNS):
        of, column, begins, follows = tile(row, given, first, 3 * STORED)
        v = tl.load(v_sh + of * (3 * TERMS) + column, (begins | follows) & (column < 3 * TERMS), 0.0)
        tl.store(v_dc + of * 3 + column, v, begins)
        if TERMS > 1:
            tl.store(v_rest + of * (3 * STORED - 3) + column - 3, v, follows)
