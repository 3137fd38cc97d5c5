"""Poses of moving objects at a time and their gradients, one kernel each: ``sparsestreet.ops.poses``.

A lane is an instance. Backward computes the pose again, and writes the gradients of all its keyframes.
"""

from functools import partial

import torch
import triton.language as tl
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.trajectories import TIME_TOLERANCE, Trajectories
from sparsestreet.ops.triton.launch import constant, jit, launch
from sparsestreet.ops.triton.quaternions import (
    conjugate,
    dot,
    inner,
    load_row,
    multiply,
    plus,
    scaled,
    store_row,
    unit_backward,
    unit_quaternion,
    weighted,
)

LANES = 32
OPTIONS = {"num_warps": 1}
TOLERANCE = constant(TIME_TOLERANCE)
# Of geometry/quaternions.py: the squared half angle below which series are taken, and the cosine above which a lerp is.
SMALL, NEAR = constant(1e-6), constant(0.9995)
# arccos(x) = sqrt(1 - x) times a polynomial, within 2e-8 for x from 0 to 1: Abramowitz and Stegun 1964, 4.4.46.
ARCCOSINE = constant(
    (
        1.5707963050, -0.2145988016, 0.0889789874, -0.0501743046,
        0.0308918810, -0.0170881256, 0.0066700901, -0.0012624911,
    )
)  # fmt: skip


def poses_at(
    keyframes: Trajectories,
    rotation_deltas: Float[Tensor, "i k 3"],
    translation_deltas: Float[Tensor, "i k 3"],
    time: float,
    max_gap: float,
) -> tuple[Float[Tensor, "i 4"], Float[Tensor, "i 3"], Bool[Tensor, " i"]]:
    """Quaternions, translations and presence, as ``sparsestreet.ops.poses`` defines them, of contiguous float32."""
    table = keyframes
    tensors = (table.times, table.valid.contiguous().view(torch.uint8), table.spans, table.quaternions)
    return _Poses.apply(rotation_deltas, translation_deltas, tensors, table.translations, time, max_gap)


class _Poses(torch.autograd.Function):
    """Maps the corrections of all keyframes to one pose per instance."""

    @staticmethod
    def forward(ctx, rotation_deltas, translation_deltas, table, centers, time, max_gap):
        ctx.set_materialize_grads(False)
        instances, length = rotation_deltas.shape[:2]
        quaternions, translations = rotation_deltas.new_empty(instances, 4), rotation_deltas.new_empty(instances, 3)
        present = rotation_deltas.new_empty(instances, dtype=torch.bool)
        launch(
            interpolate, instances, LANES,
            *table, centers, rotation_deltas, translation_deltas, quaternions, translations, present.view(torch.uint8),
            instances, length, time, max_gap + TIME_TOLERANCE, options=OPTIONS,
        )  # fmt: skip
        ctx.mark_non_differentiable(present)
        ctx.save_for_backward(*table, rotation_deltas)
        ctx.time = time
        return quaternions, translations, present

    @staticmethod
    @once_differentiable
    def backward(ctx, v_quaternions, v_translations, _v_present):
        *table, rotation_deltas = ctx.saved_tensors
        instances, length = rotation_deltas.shape[:2]
        cotangents = [
            rotation_deltas.new_zeros(instances, width) if value is None else value.contiguous()
            for value, width in ((v_quaternions, 4), (v_translations, 3))
        ]
        gradients = [torch.empty_like(rotation_deltas) for _ in range(2)]
        launch(
            interpolate_backward, instances, LANES,
            *table, rotation_deltas, *cotangents, *gradients, instances, length, ctx.time, options=OPTIONS,
        )  # fmt: skip
        return *gradients, None, None, None, None


@jit
def bracket(times, valid, spans, instance, given, length, time):
    """The keyframes around a time, the fraction between them, and the distances to the nearest keyframe and the
    span."""
    count, before = tl.zeros_like(instance), tl.zeros_like(instance)
    nearest = tl.zeros_like(instance).to(tl.float32) + float("inf")
    for k in range(length):
        at = tl.load(times + instance * length + k, given, 0.0)
        there = tl.load(valid + instance * length + k, given, 0) != 0
        count += there.to(tl.int32)
        before += (there & (at <= time)).to(tl.int32)
        nearest = tl.where(there & (tl.abs(at - time) < nearest), tl.abs(at - time), nearest)
    lower = tl.minimum(tl.maximum(before - 1, 0), tl.maximum(count - 2, 0))
    upper = tl.maximum(tl.minimum(lower + 1, count - 1), 0)
    span = load_row(spans, instance, given, 2)
    inside = tl.minimum(tl.maximum(time, span[0]), span[1])
    first = tl.load(times + instance * length + lower, given, 0.0)
    last = tl.load(times + instance * length + upper, given, 0.0)
    between = upper > lower
    fraction = tl.where(between, (inside - first) / tl.where(between, last - first, 1.0), 0.0)
    return lower, upper, fraction, nearest, tl.abs(inside - time)


@jit
def half_turn(vector):
    """Half a rotation vector; with its length h also sin(h) / h, cos(h), and the first one's derivative by h over h."""
    half = scaled(0.5, vector)
    squared = dot(half, half)
    small = squared < SMALL
    safe = tl.where(small, 1.0, squared)
    angle = tl.sqrt(safe)
    sinc = tl.where(small, 1 - squared / 6, tl.sin(angle) / angle)
    cosine = tl.where(small, 1 - squared / 2 + squared * squared / 24, tl.cos(angle))
    return half, sinc, cosine, tl.where(small, -1 / 3, (cosine - sinc) / safe)


@jit
def corrected(quaternions, rotation_deltas, keyframe, given):
    """A keyframe's corrected rotation as a unit quaternion, and the inverse of its former length."""
    half, sinc, cosine, _ = half_turn(load_row(rotation_deltas, keyframe, given, 3))
    correction = (cosine, sinc * half[0], sinc * half[1], sinc * half[2])
    return unit_quaternion(multiply(load_row(quaternions, keyframe, given, 4), correction))


@jit
def corrected_backward(quaternions, rotation_deltas, keyframe, given, unit, inverse_length, v):
    """From the gradient of the unit quaternion to that of the rotation vector."""
    half, sinc, _, slope = half_turn(load_row(rotation_deltas, keyframe, given, 3))
    v = multiply(conjugate(load_row(quaternions, keyframe, given, 4)), unit_backward(unit, inverse_length, v))
    axis = (v[1], v[2], v[3])
    return scaled(0.5, plus(scaled(sinc, axis), scaled(slope * dot(half, axis) - sinc * v[0], half)))


@jit
def arccosine(x):
    total = tl.zeros_like(x) + ARCCOSINE[7]
    for k in tl.static_range(6, -1, -1):
        total = total * x + ARCCOSINE[k]
    return tl.sqrt(1 - x) * total


@jit
def slerp_weights(cosine, fraction):
    """Weights of two unit quaternions along the shorter arc, and their derivatives by the ``cosine`` between them."""
    sign = tl.where(cosine < 0, -1.0, 1.0)
    near = tl.abs(cosine) > NEAR
    cosine = tl.where(near, 0.0, tl.abs(cosine))
    angle = arccosine(cosine)
    sine, rest = tl.sin(angle), 1 - fraction
    of_a = tl.where(near, rest, tl.sin(rest * angle) / sine)
    of_b = tl.where(near, fraction, tl.sin(fraction * angle) / sine)
    v_a = tl.where(near, 0.0, (of_a * cosine - rest * tl.cos(rest * angle)) / (sine * sine))
    v_b = tl.where(near, 0.0, (of_b * cosine - fraction * tl.cos(fraction * angle)) / (sine * sine))
    return of_a, sign * of_b, sign * v_a, v_b


@partial(jit, do_not_specialize=["instances", "length"])
def interpolate(
    times, valid, spans, quaternions, centers, rotation_deltas, translation_deltas,
    out_quaternions, out_translations, present, instances, length, time, reach, BLOCK: tl.constexpr,
):  # fmt: skip
    """``reach``: largest distance in time to the nearest keyframe at which an instance is present."""
    instance = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = instance < instances
    lower, upper, fraction, nearest, outside = bracket(times, valid, spans, instance, given, length, time)
    lower, upper = instance * length + lower, instance * length + upper
    a, _ = corrected(quaternions, rotation_deltas, lower, given)
    b, _ = corrected(quaternions, rotation_deltas, upper, given)
    of_a, of_b, _, _ = slerp_weights(inner(a, b), fraction)
    unit, _ = unit_quaternion(weighted(of_a, a, of_b, b))
    store_row(out_quaternions, instance, unit, given, 4)
    start = plus(load_row(centers, lower, given, 3), load_row(translation_deltas, lower, given, 3))
    end = plus(load_row(centers, upper, given, 3), load_row(translation_deltas, upper, given, 3))
    way = plus(end, scaled(-1.0, start))
    store_row(out_translations, instance, plus(start, scaled(fraction, way)), given, 3)
    tl.store(present + instance, ((nearest <= reach) & (outside <= TOLERANCE)).to(tl.uint8), given)


@jit
def shared(is_a, a, is_b, b):
    """The sum of vectors ``a`` (if ``is_a``) and ``b`` (if ``is_b``)."""
    return (
        tl.where(is_a, a[0], 0.0) + tl.where(is_b, b[0], 0.0),
        tl.where(is_a, a[1], 0.0) + tl.where(is_b, b[1], 0.0),
        tl.where(is_a, a[2], 0.0) + tl.where(is_b, b[2], 0.0),
    )


@partial(jit, do_not_specialize=["instances", "length"])
def interpolate_backward(
    times, valid, spans, quaternions, rotation_deltas, v_quaternions, v_translations,
    v_rotation_deltas, v_translation_deltas, instances, length, time, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of all corrections: 0 except at the two keyframes around the time, which may be the same."""
    instance = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = instance < instances
    lower, upper, fraction, _, _ = bracket(times, valid, spans, instance, given, length, time)
    first = instance * length
    a, inverse_a = corrected(quaternions, rotation_deltas, first + lower, given)
    b, inverse_b = corrected(quaternions, rotation_deltas, first + upper, given)
    of_a, of_b, slope_a, slope_b = slerp_weights(inner(a, b), fraction)
    unit, inverse_length = unit_quaternion(weighted(of_a, a, of_b, b))
    v = unit_backward(unit, inverse_length, load_row(v_quaternions, instance, given, 4))
    v_cosine = slope_a * inner(v, a) + slope_b * inner(v, b)
    v_a, v_b = weighted(of_a, v, v_cosine, b), weighted(of_b, v, v_cosine, a)
    v_a = corrected_backward(quaternions, rotation_deltas, first + lower, given, a, inverse_a, v_a)
    v_b = corrected_backward(quaternions, rotation_deltas, first + upper, given, b, inverse_b, v_b)
    v_place = load_row(v_translations, instance, given, 3)
    shift_a, shift_b = scaled(1 - fraction, v_place), scaled(fraction, v_place)
    for k in range(length):
        store_row(v_rotation_deltas, first + k, shared(k == lower, v_a, k == upper, v_b), given, 3)
        store_row(v_translation_deltas, first + k, shared(k == lower, shift_a, k == upper, shift_b), given, 3)
