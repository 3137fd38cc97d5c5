"""Activation of stored rows by the C++ library, as an autograd function."""

from ctypes import byref

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.activate import Placement, RawGaussians
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.workspace import FASTEST_VARIANT
from sparsestreet.phases import phase
from sparsestreet.types import Gaussians


def activate(
    raw: RawGaussians,
    terms: int,
    multipliers: Float[Tensor, " n"] | None,
    placement: Placement | None,
    logit_limit: float,
    variant: int = FASTEST_VARIANT,
) -> Gaussians:
    """As ``sparsestreet.ops.activate``, with so many coefficients; the same bits for any number of threads."""
    poses = (None,) * 4
    if placement is not None:
        at = placement.poses
        poses = (at.quaternions, at.translations, placement.instances, at.present)
    fields = (raw.means, raw.log_scales, raw.quaternions, raw.opacity_logits, raw.sh_dc, raw.sh_rest)
    scales, opacities, sh, *placed = _Activate.apply(*fields, multipliers, *poses, terms, logit_limit, variant)
    means, quaternions = placed if placement is not None else (raw.means, raw.quaternions)
    return Gaussians(means, quaternions, scales, opacities, sh)


class _Activate(torch.autograd.Function):
    """Stored rows, multipliers and poses to scales, opacities, coefficients and, with poses, means and quaternions."""

    @staticmethod
    def forward(ctx, *given):
        *tensors, terms, logit_limit, variant = given
        tensors = [None if tensor is None else tensor.contiguous() for tensor in tensors]
        means, placed = tensors[0], tensors[7] is not None
        n = means.shape[0]
        sh = means.new_empty(n, terms, 3)
        outputs = [torch.empty_like(means), means.new_empty(n, 4)] if placed else [None, None]
        outputs += [torch.empty_like(means), means.new_empty(n), sh]
        ctx.settings = (terms, logit_limit, variant)
        status = native.load_library().splat_activate(
            int(means.dtype == torch.float64), variant, byref(_rows(tensors, terms, logit_limit)),
            byref(native.ActiveRows(*_pointers(outputs))),
        )  # fmt: skip
        _raise_for(status)
        ctx.save_for_backward(*tensors)
        return (*outputs[2:], *outputs[:2]) if placed else tuple(outputs[2:])

    @staticmethod
    @once_differentiable
    def backward(ctx, v_scales, v_opacities, v_sh, v_means=None, v_quaternions=None):
        tensors = list(ctx.saved_tensors)
        terms, logit_limit, variant = ctx.settings
        placed = tensors[7] is not None
        cotangents = [
            None if value is None else value.contiguous()
            for value in (v_means, v_quaternions, v_scales, v_opacities, v_sh)
        ]
        # Means and quaternions that are not placed did not come through here.
        gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in tensors[:9]]
        if not placed:
            gradients[0] = gradients[2] = None
        # As in torch: an optimizer leaves alone what has no part in the image yet.
        if terms == 1:
            gradients[5] = None
        with phase("scene backward"):
            status = native.load_library().splat_activate_backward(
                int(tensors[1].dtype == torch.float64), variant, byref(_rows(tensors, terms, logit_limit)),
                byref(native.ActiveRows(*_pointers(cotangents))), byref(native.RawGradients(*_pointers(gradients))),
            )  # fmt: skip
        _raise_for(status)
        return *gradients, None, None, None, None, None


def _rows(tensors: list[Tensor | None], terms: int, logit_limit: float) -> native.RawRows:
    """The struct of six fields, multipliers, pose quaternions, pose translations, instances, presence."""
    *fields, multipliers, turns, shifts, instances, present = tensors
    pointers = _pointers([*fields, multipliers, instances])
    poses = _pointers([turns, shifts, present])
    rest = fields[5].shape[1]
    num_instances = 0 if turns is None else turns.shape[0]
    return native.RawRows(
        fields[0].shape[0], rest, terms, logit_limit, *pointers, num_instances, *poses, native.thread_count()
    )


def _pointers(tensors: list[Tensor | None]) -> list[int | None]:
    return [None if tensor is None else tensor.data_ptr() for tensor in tensors]


def _raise_for(status: int) -> None:
    if status == native.STATUS_OUT_OF_MEMORY:
        raise MemoryError("no memory to sum the gradients of poses: activate fewer rows at once")
