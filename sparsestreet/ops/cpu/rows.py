"""Rows of Gaussians by the C++ library: activated, and placed by the poses of their objects."""

from collections.abc import Sequence
from ctypes import byref

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.trajectories import TIME_TOLERANCE, Trajectories
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT
from sparsestreet.ops.raw import LEARNED, OPACITY_LOGIT_LIMIT, Inputs, RawGaussians, split_parts
from sparsestreet.phases import phase


def activate(parts: Sequence[RawGaussians], variant: int = FASTEST_VARIANT) -> Sequence[Tensor]:
    """Means, quaternions, scales and opacities of ``sparsestreet.ops.activate`` in C++, bitwise the same for any number
    of threads."""
    return _Activate.apply(variant, *(tensor for part in parts for tensor in part.tensors()))


class _Activate(torch.autograd.Function):
    """Maps stored rows, multipliers and poses of all parts to means, quaternions, scales and opacities."""

    @staticmethod
    def forward(ctx, variant, *given):
        tensors = [None if tensor is None else tensor.contiguous() for tensor in given]
        ctx.save_for_backward(*tensors)
        ctx.kind = (given[0].dtype == torch.float64, variant)
        parts = split_parts(tensors)
        outputs = [given[0].new_empty(parts[-1][0].stop, *width) for width in ((3,), (4,), (3,), ())]
        for rows, part in parts:
            active = native.pointers(*(output[rows] for output in outputs))
            _raise_for(native.load_library().splat_activate(*ctx.kind, byref(_rows(part)), byref(active)))
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *cotangents):
        gradients = []
        with phase("scene backward"):
            cotangents = [value.contiguous() for value in cotangents]
            for rows, part in split_parts(ctx.saved_tensors):
                gradients += _part_backward(ctx, part, [value[rows] for value in cotangents])
        return None, *gradients


def _part_backward(ctx, part: Inputs, cotangents: list[Tensor]) -> list[Tensor | None]:
    """Gradients of a part's inputs from those of its rows."""
    gradients: list[Tensor | None] = [None if tensor is None else torch.empty_like(tensor) for tensor in part[:LEARNED]]
    placed = part[LEARNED] is not None
    if not placed:
        # Means and quaternions passed through unchanged.
        gradients[0] = gradients[2] = None
    active, raw = native.pointers(*cotangents), native.pointers(*gradients)
    _raise_for(native.load_library().splat_activate_backward(*ctx.kind, byref(_rows(part)), byref(active), byref(raw)))
    if not placed:
        gradients[0], gradients[2] = cotangents[:2]
    return [*gradients, None, None]


def _rows(part: Inputs) -> native.CRawRows:
    *fields, multipliers, turns, shifts, instances, present = part
    return native.CRawRows(
        fields[0].shape[0], OPACITY_LOGIT_LIMIT,
        *native.pointers(*fields, multipliers, instances), 0 if turns is None else turns.shape[0],
        *native.pointers(turns, shifts, present), native.thread_count(),
    )  # fmt: skip


def _raise_for(status: int) -> None:
    if status == native.STATUS_OUT_OF_MEMORY:
        raise MemoryError("no memory to sum the gradients of poses: activate fewer rows at once")


_INPUTS = 6
"""Count of numbers that an instance's rotation depends on: two rotation vectors."""


def poses_at(
    keyframes: Trajectories,
    rotation_deltas: Float[Tensor, "i k 3"],
    translation_deltas: Float[Tensor, "i k 3"],
    time: float,
    max_gap: float,
    variant: int = FASTEST_VARIANT,
) -> tuple[Float[Tensor, "i 4"], Float[Tensor, "i 3"], Bool[Tensor, " i"]]:
    """Quaternions, translations and presence, as ``sparsestreet.ops.poses`` defines them; computed in double."""
    table = keyframes
    tensors = (table.times, table.quaternions, table.translations, table.valid, table.spans)
    return _Poses.apply(rotation_deltas, translation_deltas, tensors, time, max_gap, variant)


class _Poses(torch.autograd.Function):
    """Maps the corrections of all keyframes to one pose per instance."""

    @staticmethod
    def forward(ctx, rotation_deltas, translation_deltas, table, time, max_gap, variant):
        ctx.set_materialize_grads(False)
        tensors = [tensor.contiguous() for tensor in (*table, rotation_deltas, translation_deltas)]
        instances, length = rotation_deltas.shape[:2]
        quaternions, translations = rotation_deltas.new_empty(instances, 4), rotation_deltas.new_empty(instances, 3)
        present = torch.empty(instances, dtype=torch.bool)
        slopes = torch.empty(instances, 4, _INPUTS, dtype=torch.float64)
        fractions = torch.empty(instances, dtype=torch.float64)
        places = torch.empty(instances, 2, dtype=torch.int64)
        keyframes = native.CKeyframes(instances, length, *native.pointers(*tensors), time, max_gap, TIME_TOLERANCE)
        poses = native.pointers(quaternions, translations, present, slopes, fractions, places)
        native.load_library().splat_poses(
            rotation_deltas.dtype == torch.float64, variant, byref(keyframes), byref(poses)
        )
        ctx.mark_non_differentiable(present)
        ctx.save_for_backward(slopes, fractions, places)
        ctx.shape, ctx.variant = rotation_deltas.shape, variant
        return quaternions, translations, present

    @staticmethod
    @once_differentiable
    def backward(ctx, v_quaternions, v_translations, _v_present):
        slopes, fractions, places = ctx.saved_tensors
        some = v_quaternions if v_quaternions is not None else v_translations
        if some is None:
            return (None,) * 6
        instances = ctx.shape[0]
        cotangents = [
            some.new_zeros(instances, width) if value is None else value.contiguous()
            for value, width in ((v_quaternions, 4), (v_translations, 3))
        ]
        rotation_deltas, translation_deltas = some.new_zeros(ctx.shape), some.new_zeros(ctx.shape)
        native.load_library().splat_poses_backward(
            some.dtype == torch.float64, ctx.variant, instances,
            byref(native.pointers(None, None, None, slopes, fractions, places)),
            *native.pointers(*cotangents, rotation_deltas, translation_deltas),
        )  # fmt: skip
        return rotation_deltas, translation_deltas, None, None, None, None
