"""Structural similarity with an 11x11 Gaussian window, as a training loss (Wang et al. 2004; 3DGS's D-SSIM).

It is our own because the loss runs at every step. In plain torch it takes a quarter of the time of
``kornia.losses.ssim_loss`` at 320x192 on two cores, and in C++ (``cpu/ssim.py``) a seventh of that. It is tested
against kornia. Reported SSIM is defined differently (``metrics/``).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from sparsestreet.ops.backend import fused_backend
from sparsestreet.ops.cpu import images as cpu_ssim
from sparsestreet.ops.ssim_window import C1, C2, WINDOW, window


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], *, backend: str = "auto") -> Float[Tensor, ""]:
    """Mean SSIM over the pixels whose window lies inside the image. Gradients go to the image only.

    ``backend``: "torch", "cpu" (C++), "triton", or "auto" for the one that suits the tensors. Raises as
    :func:`sparsestreet.ops.backend.fused_backend` does, and ValueError below 11x11 pixels or for different shapes.
    """
    check_sizes(image, truth)
    image, truth = image.contiguous(), truth.detach().contiguous()
    chosen = fused_backend(backend, image, truth)
    if chosen == "cpu":
        return cpu_ssim.mean_ssim(image, truth)
    if chosen == "triton":
        from sparsestreet.ops.triton.ssim import mean_ssim

        return mean_ssim(image, truth)
    x, y = image.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None]
    moments = _blur(torch.cat((x, y, x * x, y * y, x * y), dim=1))
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments.chunk(5, dim=1)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    luminance = (2 * product + C1) / (squares + C1)
    contrast_structure = (2 * (mean_xy - product) + C2) / (mean_xx + mean_yy - squares + C2)
    return (luminance * contrast_structure).mean()


def check_sizes(image: Tensor, truth: Tensor) -> None:
    """Raise ValueError for images of different shapes, or smaller than the window."""
    if image.shape != truth.shape:
        raise ValueError(f"SSIM compares images of one shape, got {tuple(image.shape)} and {tuple(truth.shape)}")
    if min(image.shape[:2]) < WINDOW:
        raise ValueError(f"SSIM needs at least {WINDOW}x{WINDOW} pixels, got {tuple(image.shape[:2])}")


def _blur(planes: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 c i j"]:
    """Separable Gaussian window, valid pixels only."""
    channels = planes.shape[1]
    taps = torch.tensor(window(), dtype=planes.dtype, device=planes.device).expand(channels, 1, 1, WINDOW)
    return conv2d(conv2d(planes, taps, groups=channels), taps.mT, groups=channels)
