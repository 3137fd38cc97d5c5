"""SSIM and its gradient in C++, one call each: ``sparsestreet.ops.ssim`` for images on the CPU (src/ssim.hpp)."""

from ctypes import byref, c_double

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.workspace import FASTEST_VARIANT
from sparsestreet.ops.ssim_window import C1, C2, WINDOW, window
from sparsestreet.phases import phase

TAPS = (c_double * WINDOW)(*window())


def mean_ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], variant: int = FASTEST_VARIANT
) -> Float[Tensor, ""]:
    """``sparsestreet.ops.ssim.ssim`` of contiguous images, both float32 or both float64.

    Bitwise the same for any number of threads. ``variant`` picks an instruction set, as in
    :func:`sparsestreet.ops.cpu.rasterizer.rasterize`. Raises MemoryError without room for the sums.
    """
    return _MeanSSIM.apply(image, truth, variant)


class _MeanSSIM(torch.autograd.Function):
    """Forward keeps three partial derivatives per number of the SSIM map; backward blurs them."""

    @staticmethod
    def forward(ctx, image, truth, variant):
        height, width, channels = image.shape
        kept = 3 if ctx.needs_input_grad[0] else 0
        partials = image.new_empty(kept, height - WINDOW + 1, width - WINDOW + 1, channels)
        mean = image.new_empty(())
        kind = (image.dtype == torch.float64, variant)
        status = native.load_library().splat_ssim(
            *kind, byref(_pair(image, truth)), partials.data_ptr() if kept else None, mean.data_ptr()
        )
        if status != native.STATUS_OK:
            raise MemoryError("no memory for the sums of SSIM: compare smaller images")
        ctx.save_for_backward(image, truth, partials)
        ctx.kind = kind
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx, v_mean):
        image, truth, partials = ctx.saved_tensors
        v_image = torch.empty_like(image)
        with phase("ssim backward"):
            native.load_library().splat_ssim_backward(
                *ctx.kind, byref(_pair(image, truth)), partials.data_ptr(), v_mean.data_ptr(), v_image.data_ptr()
            )
        return v_image, None, None


def _pair(image: Tensor, truth: Tensor) -> native.CImagePair:
    height, width, _ = image.shape
    return native.CImagePair(image.data_ptr(), truth.data_ptr(), height, width, TAPS, C1, C2, native.thread_count())
