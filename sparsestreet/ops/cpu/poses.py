"""Poses of moving objects at a time by the C++ library, as an autograd function."""

from ctypes import byref

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.trajectories import TIME_TOLERANCE, Trajectories
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.workspace import FASTEST_VARIANT

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
        native.load_library().splat_poses(
            int(rotation_deltas.dtype == torch.float64),
            variant,
            byref(
                native.CKeyframes(
                    instances, length, *(tensor.data_ptr() for tensor in tensors), time, max_gap, TIME_TOLERANCE
                )
            ),
            byref(_pointers(quaternions, translations, present, slopes, fractions, places)),
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
            int(some.dtype == torch.float64),
            ctx.variant,
            instances,
            byref(_pointers(None, None, None, slopes, fractions, places)),
            *(tensor.data_ptr() for tensor in (*cotangents, rotation_deltas, translation_deltas)),
        )
        return rotation_deltas, translation_deltas, None, None, None, None


def _pointers(*tensors: Tensor | None) -> native.CInstancePoses:
    return native.CInstancePoses(*(None if tensor is None else tensor.data_ptr() for tensor in tensors))
