"""Rows of Gaussians by the C++ library: activated, and placed by the poses of their objects."""

from collections.abc import Sequence
from ctypes import byref
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.trajectories import TIME_TOLERANCE, Trajectories
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT
from sparsestreet.ops.raw import INPUTS, LEARNED, Inputs, RawGaussians
from sparsestreet.phases import phase
from sparsestreet.types import Gaussians

FIELDS = 6
"""Number of fields: means, log-scales, quaternions, opacity logits, first coefficient, the others."""


def activate(
    parts: Sequence[RawGaussians], sh_degree: int, logit_limit: float, variant: int = FASTEST_VARIANT
) -> Gaussians:
    """``sparsestreet.ops.activate`` in C++, bitwise the same for any number of threads."""
    terms = [part.terms(sh_degree) for part in parts]
    tensors = [tensor for part in parts for tensor in part.tensors()]
    return Gaussians(*_Activate.apply(_Call(terms, logit_limit, variant), *tensors))


@dataclass(frozen=True)
class _Call:
    """What all parts share, and the number of coefficients of each."""

    terms: list[int]
    logit_limit: float
    variant: int


class _Activate(torch.autograd.Function):
    """Maps stored rows, multipliers and poses of all parts to means, quaternions, scales, opacities, coefficients."""

    @staticmethod
    def forward(ctx, call, *given):
        tensors = [None if tensor is None else tensor.contiguous() for tensor in given]
        means = given[0]
        n = sum(len(part[0]) for part in _parts(tensors))
        widths = ((3,), (4,), (3,), (), (max(call.terms), 3))
        outputs = [means.new_empty(n, *width) for width in widths]
        for rows, part, terms in _walk(tensors, call):
            status = native.load_library().splat_activate(
                int(means.dtype == torch.float64), call.variant, byref(_rows(part, terms, call)),
                byref(native.CActiveRows(*_pointers([output[rows] for output in outputs]))),
            )  # fmt: skip
            _raise_for(status)
        ctx.save_for_backward(*tensors)
        ctx.call = call
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *cotangents):
        call, gradients = ctx.call, []
        with phase("scene backward"):
            cotangents = [value.contiguous() for value in cotangents]
            for rows, part, terms in _walk(ctx.saved_tensors, call):
                gradients += _part_backward(part, terms, call, [value[rows] for value in cotangents])
        return None, *gradients


def _part_backward(part: Inputs, terms: int, call: _Call, cotangents: list[Tensor]) -> list[Tensor | None]:
    """Gradients of a part's inputs from those of its rows."""
    gradients: list[Tensor | None] = [None if tensor is None else torch.empty_like(tensor) for tensor in part[:LEARNED]]
    if part[LEARNED] is None:
        # Means and quaternions passed through unchanged.
        gradients[0] = gradients[2] = None
    # As in torch, so that an optimizer skips coefficients that are not in use yet.
    if terms == 1:
        gradients[FIELDS - 1] = None
    status = native.load_library().splat_activate_backward(
        int(part[0].dtype == torch.float64), call.variant, byref(_rows(part, terms, call)),
        byref(native.CActiveRows(*_pointers(cotangents))), byref(native.CRawGradients(*_pointers(gradients))),
    )  # fmt: skip
    _raise_for(status)
    if part[LEARNED] is None:
        gradients[0], gradients[2] = cotangents[:2]
    return [*gradients, None, None]


def _parts(tensors: Sequence[Tensor | None]) -> list[Inputs]:
    return [cast(Inputs, tuple(tensors[start : start + INPUTS])) for start in range(0, len(tensors), INPUTS)]


def _walk(tensors: Sequence[Tensor | None], call: _Call) -> list[tuple[slice, Inputs, int]]:
    """For each part its rows in the table, its inputs, and its number of coefficients."""
    found, start = [], 0
    for part, terms in zip(_parts(tensors), call.terms, strict=True):
        found.append((slice(start, start + len(part[0])), part, terms))
        start += len(part[0])
    return found


def _rows(part: Inputs, terms: int, call: _Call) -> native.CRawRows:
    *fields, multipliers, turns, shifts, instances, present = part
    return native.CRawRows(
        fields[0].shape[0], fields[-1].shape[1], terms, max(call.terms), call.logit_limit,
        *_pointers([*fields, multipliers, instances]), 0 if turns is None else turns.shape[0],
        *_pointers([turns, shifts, present]), native.thread_count(),
    )  # fmt: skip


def _pointers(tensors: Sequence[Tensor | None]) -> list[int | None]:
    return [None if tensor is None else tensor.data_ptr() for tensor in tensors]


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
        native.load_library().splat_poses(
            int(rotation_deltas.dtype == torch.float64),
            variant,
            byref(
                native.CKeyframes(
                    instances, length, *(tensor.data_ptr() for tensor in tensors), time, max_gap, TIME_TOLERANCE
                )
            ),
            byref(_pointers_poses(quaternions, translations, present, slopes, fractions, places)),
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
            byref(_pointers_poses(None, None, None, slopes, fractions, places)),
            *(tensor.data_ptr() for tensor in (*cotangents, rotation_deltas, translation_deltas)),
        )
        return rotation_deltas, translation_deltas, None, None, None, None


def _pointers_poses(*tensors: Tensor | None) -> native.CInstancePoses:
    return native.CInstancePoses(*(None if tensor is None else tensor.data_ptr() for tensor in tensors))
