"""The photometric loss of 3DGS (Kerbl et al. 2023): L1 and D-SSIM of an image against a recorded one of 8 bits.

A fused one takes two passes over the images forward, and two backward; in plain torch they are fifteen and twenty-five.
"""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.cpu import images as cpu_images
from sparsestreet.ops.ssim import check_sizes, ssim

NO_LEVEL = 256
"""Above all levels."""


def photometric(
    image: Float[Tensor, "h w 3"],
    recorded: UInt8[Tensor, "h w 3"],
    *,
    lambda_dssim: float,
    white: int | None = None,
    weight: float = 1.0,
    backend: str = "auto",
) -> Float[Tensor, ""]:
    """Return ``weight`` ((1 - lambda) L1 + lambda (1 - SSIM)), means over the numbers and as ``ssim`` defines them.

    Where a recorded number is of level ``white`` or above, an image above it counts as equal, and has no gradient.
    ``backend``: "torch", "cpu" (C++), "triton", or "auto" for the one that suits the tensors. Raises as
    :func:`sparsestreet.ops.ssim.ssim` does, but without D-SSIM (lambda 0) takes images of any size, and torch.
    """
    image, recorded = image.contiguous(), recorded.contiguous()
    chosen = fused_backend(backend, image) if lambda_dssim > 0 else "torch"
    if chosen != "torch":
        level = NO_LEVEL if white is None else white
        check_sizes(image, recorded)
        return _Photometric.apply(image, recorded, lambda_dssim, level, weight, chosen)
    truth = recorded.to(image.dtype) / 255
    if white is not None:
        image = torch.where((recorded >= white) & (image > truth), truth, image)
    error = (image - truth).abs().mean()
    if lambda_dssim > 0:
        error = (1 - lambda_dssim) * error + lambda_dssim * (1 - ssim(image, truth, backend="torch"))
    return weight * error


class _Photometric(torch.autograd.Function):
    """Value and gradient are those of ``offset + scale * sum |x - y| - share * SSIM``."""

    @staticmethod
    def forward(ctx, image, recorded, lambda_dssim, white, weight, chosen):
        scale, share = weight * (1 - lambda_dssim) / image.numel(), weight * lambda_dssim
        ctx.module, ctx.numbers = _module(chosen), (white, scale, share)
        value, *kept = ctx.module.compare(image, recorded, white, scale, share, ctx.needs_input_grad[0])
        ctx.save_for_backward(image, recorded, *kept)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx, v_value):
        return ctx.module.compare_backward(*ctx.saved_tensors, v_value, *ctx.numbers), None, None, None, None, None


def _module(chosen: str):
    if chosen == "cpu":
        return cpu_images
    from sparsestreet.ops.triton import photometric

    return photometric
