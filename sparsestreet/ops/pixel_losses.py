"""Losses that are a weighted mean over pixels of one number each: rendered depth against returns, alpha against a sky.

A fused one looks at the pixels once, and writes what the gradient will be multiplied by as well. In plain torch each is
twenty small operations forward and as many backward.
"""

from ctypes import byref, c_double

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT

DEPTH, INVERSE_DEPTH, SKY = range(3)
"""Kinds of terms, as in cpu/src/interface.h. Numbers of depths are the nearest and farthest return and the nearest
rendered depth; of a sky epsilon, the floor, and nothing."""


def depth_error(
    rendered: Float[Tensor, "h w"],
    measured: Float[Tensor, "h w"],
    *,
    weight: float = 1.0,
    nearest: float = 0.0,
    farthest: float = torch.inf,
    nearest_rendered: float = 0.0,
    inverse: bool = True,
    backend: str = "auto",
) -> Float[Tensor, ""]:
    """Return the mean |1 / rendered - 1 / measured| (not ``inverse``: |rendered - measured|), times ``weight``.

    Only pixels count with nearest < measured < farthest and rendered > nearest_rendered, all meters; without any it is
    0. Gradients go to ``rendered`` only. ``backend``: "torch", "cpu" (C++), "triton", or "auto" for the one that suits
    the tensors. Raises as :func:`sparsestreet.ops.backend.fused_backend` does.
    """
    rendered, measured = rendered.contiguous(), measured.detach().contiguous()
    chosen = fused_backend(backend, rendered, measured)
    if chosen != "torch":
        kind, numbers = INVERSE_DEPTH if inverse else DEPTH, (nearest, farthest, nearest_rendered)
        return _PixelMean.apply(rendered, measured, (kind, numbers, weight), chosen)
    valid = (measured > nearest) & (measured < farthest) & (rendered > nearest_rendered)
    # Over all pixels, because picking the valid ones would wait for a device; 1 m stands where none is.
    rendered, measured = torch.where(valid, rendered, 1.0), torch.where(valid, measured, 1.0)
    error = 1 / rendered - 1 / measured if inverse else rendered - measured
    return weight * (error.abs().sum() / valid.sum().clamp(min=1))


def sky_entropy(
    alpha: Float[Tensor, "h w"],
    sky: Bool[Tensor, "h w"],
    *,
    weight: float = 1.0,
    eps: float = 1e-3,
    floor: float | None = None,
    backend: str = "auto",
) -> Float[Tensor, ""]:
    """Return the mean -log((r + eps) / (1 + eps)), times ``weight``; r is 1 - alpha in the sky and alpha elsewhere.

    With a ``floor`` r is no less than it, and its gradient that of an r that is the floor. ``backend`` and what is
    raised: as for :func:`depth_error`.
    """
    alpha, sky = alpha.contiguous(), sky.contiguous()
    chosen = fused_backend(backend, alpha)
    if chosen != "torch":
        numbers = (eps, -torch.inf if floor is None else floor, 0.0)
        return _PixelMean.apply(alpha, sky, (SKY, numbers, weight), chosen)
    right = torch.where(sky, 1 - alpha, alpha)
    if floor is not None:
        # The value of the clamped number with the gradient of the number itself.
        right = right + (floor - right.detach()).relu()
    return -weight * ((right + eps) / (1 + eps)).log().mean()


class _PixelMean(torch.autograd.Function):
    """Forward keeps the derivative of each pixel's number, and the weight over the number of pixels that count."""

    @staticmethod
    def forward(ctx, predicted, truth, term, chosen):
        slopes = torch.empty_like(predicted) if ctx.needs_input_grad[0] else None
        mean, share = predicted.new_empty(()), predicted.new_empty(())
        mean_of_ = _mean_in_library_
        if chosen == "triton":
            from sparsestreet.ops.triton.pixel_losses import mean_of_
        kind, numbers, weight = term
        mean_of_(predicted, truth, kind, numbers, weight, slopes, mean, share)
        ctx.save_for_backward(slopes, share)
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx, v_mean):
        slopes, share = ctx.saved_tensors
        return slopes * (v_mean * share), None, None, None


def _mean_in_library_(
    predicted: Tensor,
    truth: Tensor,
    kind: int,
    numbers: tuple[float, float, float],
    weight: float,
    slopes: Tensor | None,
    mean: Tensor,
    share: Tensor,
) -> None:
    """Write the mean, the share of each pixel's derivative in that of the mean, and the derivatives.

    Raises MemoryError without room for the sums.
    """
    term = native.CPixelTerm(kind, predicted.numel(), (c_double * 3)(*numbers), weight, native.thread_count())
    tensors = native.pointers(predicted, truth, slopes, mean, share)
    status = native.load_library().splat_pixel_mean(
        predicted.dtype == torch.float64, FASTEST_VARIANT, byref(term), *tensors
    )
    if status != native.STATUS_OK:
        raise MemoryError("no memory for the sums of a loss: compare smaller images")
