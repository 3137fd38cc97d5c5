"""Images by the C++ library: the sky behind the splats, D-SSIM, and the photometric loss around it."""

import itertools
from ctypes import byref, c_double

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from sparsestreet.geometry.cameras import ray_directions, ray_matrix
from sparsestreet.ops.cpu import library as native
from sparsestreet.ops.cpu.library import FASTEST_VARIANT
from sparsestreet.ops.cube_map import bordered_texels
from sparsestreet.ops.ssim_window import C1, C2, WINDOW, window
from sparsestreet.phases import phase
from sparsestreet.types import Camera


def over_sky(
    rgb: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    texels: Float[Tensor, "6 r r 3"],
    camera: Camera,
    transmittance_min: float,
    variant: int = FASTEST_VARIANT,
) -> Float[Tensor, "h w 3"]:
    """``sparsestreet.ops.over_sky`` of contiguous tensors of one dtype, float32 or float64.

    Values and gradients are bitwise the same for any number of threads. ``variant`` is as for the splats."""
    return _OverSky.apply(rgb, alpha, texels, camera, transmittance_min, variant)


class _OverSky(torch.autograd.Function):
    """Adds the sky. Backward reads the texels again, because keeping an image of colors would cost more."""

    @staticmethod
    def forward(ctx, rgb, alpha, texels, camera, transmittance_min, variant):
        out = torch.empty_like(rgb)
        directions = None if camera.distortion is None else ray_directions(camera).to(rgb)
        sky = _sky(texels, camera, transmittance_min, directions)
        native.load_library().splat_over_sky(
            rgb.dtype == torch.float64, variant, byref(sky), rgb.data_ptr(), alpha.data_ptr(), out.data_ptr()
        )
        ctx.save_for_backward(alpha, texels, directions)
        ctx.camera, ctx.transmittance_min, ctx.variant = camera, transmittance_min, variant
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, v_out):
        with phase("sky backward"):
            alpha, texels, directions = ctx.saved_tensors
            _, wants_alpha, wants_texels, *_ = ctx.needs_input_grad
            v_alpha = torch.empty_like(alpha) if wants_alpha else None
            v_texels = torch.empty_like(texels) if wants_texels else None
            sky = _sky(texels, ctx.camera, ctx.transmittance_min, directions)
            cotangent = v_out.contiguous()
            native.load_library().splat_over_sky_backward(
                alpha.dtype == torch.float64, ctx.variant, byref(sky), alpha.data_ptr(), cotangent.data_ptr(),
                native.pointer(v_alpha), native.pointer(v_texels),
            )  # fmt: skip
            return v_out, v_alpha, v_texels, None, None, None


def _sky(texels: Tensor, camera: Camera, transmittance_min: float, directions: Tensor | None) -> native.CSky:
    return native.CSky(
        rays=(c_double * 9)(*itertools.chain(*ray_matrix(camera))),
        transmittance_min=transmittance_min,
        width=camera.width,
        height=camera.height,
        side=texels.shape[1],
        threads=native.thread_count(),
        bordered=bordered_texels(texels.shape[1], texels.device).data_ptr(),
        texels=texels.data_ptr(),
        directions=native.pointer(directions),
    )


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
        mean, partials = _similarity(image, truth, ctx.needs_input_grad[0], variant)
        ctx.save_for_backward(image, truth, partials)
        ctx.variant = variant
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx, v_mean):
        image, truth, partials = ctx.saved_tensors
        return _similarity_gradient(image, truth, partials, v_mean, ctx.variant), None, None


def _similarity(image: Tensor, truth: Tensor, keep: bool, variant: int) -> tuple[Tensor, Tensor]:
    """Return the mean, and if ``keep`` the three derivatives."""
    height, width, channels = image.shape
    partials = image.new_empty(3 if keep else 0, height - WINDOW + 1, width - WINDOW + 1, channels)
    mean = image.new_empty(())
    status = native.load_library().splat_ssim(
        image.dtype == torch.float64, variant, byref(_pair(image, truth)), partials.data_ptr() if keep else None,
        mean.data_ptr(),
    )  # fmt: skip
    if status != native.STATUS_OK:
        raise MemoryError("no memory for the sums of SSIM: compare smaller images")
    return mean, partials


def _similarity_gradient(image: Tensor, truth: Tensor, partials: Tensor, v_mean: Tensor, variant: int) -> Tensor:
    v_image = torch.empty_like(image)
    with phase("ssim backward"):
        native.load_library().splat_ssim_backward(
            image.dtype == torch.float64, variant, byref(_pair(image, truth)), partials.data_ptr(), v_mean.data_ptr(),
            v_image.data_ptr(),
        )  # fmt: skip
    return v_image


def _pair(image: Tensor, truth: Tensor) -> native.CImagePair:
    height, width, _ = image.shape
    return native.CImagePair(image.data_ptr(), truth.data_ptr(), height, width, TAPS, C1, C2, native.thread_count())


def compare(
    image: Tensor, recorded: Tensor, white: int, scale: float, share: float, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the value of ``sparsestreet.ops.photometric``; the image where it counts, the truth in its numbers, and
    the derivatives of SSIM. Raises MemoryError without room for the sums."""
    seen, truth, error = torch.empty_like(image), torch.empty_like(image), image.new_empty(())
    status = native.load_library().splat_colors(
        image.dtype == torch.float64, FASTEST_VARIANT, byref(_colors(image, recorded, white, scale)),
        *native.pointers(seen, truth, error),
    )  # fmt: skip
    if status != native.STATUS_OK:
        raise MemoryError("no memory for the sums of L1: compare smaller images")
    mean, partials = _similarity(seen, truth, keep, FASTEST_VARIANT)
    return error.add_(1 - mean, alpha=share), seen, truth, partials


def compare_backward(
    image: Tensor,
    recorded: Tensor,
    seen: Tensor,
    truth: Tensor,
    partials: Tensor,
    v_value: Tensor,
    white: int,
    scale: float,
    share: float,
) -> Tensor:
    """Return the gradient of the image."""
    v_image = _similarity_gradient(seen, truth, partials, v_value * -share, FASTEST_VARIANT)
    native.load_library().splat_colors_backward(
        image.dtype == torch.float64, FASTEST_VARIANT, byref(_colors(image, recorded, white, scale)),
        *native.pointers(truth, v_value, v_image),
    )  # fmt: skip
    return v_image


def _colors(image: Tensor, recorded: Tensor, white: int, scale: float) -> native.CColors:
    return native.CColors(*native.pointers(image, recorded), image.numel(), white, scale, native.thread_count())
