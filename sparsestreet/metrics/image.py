"""PSNR and SSIM of one image, full and masked, as defined in ``definitions``.

Images are [h, w, 3] in [0, 1]. Sums run in float64: in float32 the variance of a flat sky, E[x^2] - E[x]^2, loses
the digits that SSIM's small constants compare it with.
"""

import math

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sparsestreet.metrics.definitions import PSNR_CAP

WINDOW = 7
"""Side of SSIM's uniform window, pixels."""
BORDER = WINDOW // 2


def mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Mean squared error over pixels and channels. Raises ValueError if shapes differ or the image is empty."""
    return float(_mse(image, truth))


def masked_mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float | None:
    """Mean squared error over the masked pixels and channels; None where the mask is empty."""
    _check_pair(image, truth)
    _check_mask(mask, image)
    if not bool(mask.any()):
        return None
    return float((image[mask].double() - truth[mask].double()).square().mean())


def psnr_of_mse(error: float) -> float:
    """-10 log10(error) in dB, at most ``PSNR_CAP``; NaN stays NaN."""
    return PSNR_CAP if error == 0 else min(-10 * math.log10(error), PSNR_CAP)


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Peak signal-to-noise ratio over all pixels, dB, at most ``PSNR_CAP``."""
    return psnr_of_mse(mse(image, truth))


def psnr_on_device(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, ""]:
    """:func:`psnr` without a wait for the device, for numbers that are logged in the middle of a step."""
    return (-10 * _mse(image, truth).log10()).clamp(max=PSNR_CAP)


def masked_psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> float | None:
    """PSNR of the masked pixels alone, dB; None where the mask is empty."""
    error = masked_mse(image, truth, mask)
    return None if error is None else psnr_of_mse(error)


def ssim_map(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    """Structural similarity per pixel and channel (Wang et al. 2004, uniform window, sample covariance).

    ((2 ux uy + C1)(2 vxy + C2)) / ((ux^2 + uy^2 + C1)(vx + vy + C2)) with C1 = 0.01^2, C2 = 0.03^2 and window
    statistics over 7x7 pixels; outside the image the pixels are mirrored, the edge pixel included.
    Raises ValueError for images with a side below 7.
    """
    _check_pair(image, truth)
    if min(image.shape[:2]) < WINDOW:
        raise ValueError(
            f"SSIM needs images of at least {WINDOW}x{WINDOW} pixels, got {image.shape[1]}x{image.shape[0]}: "
            "evaluate at a higher resolution"
        )
    x, y = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = _window_means(torch.stack((x, y, x * x, y * y, x * y)))
    unbiased = WINDOW**2 / (WINDOW**2 - 1)
    variances = unbiased * (mean_xx - mean_x * mean_x + mean_yy - mean_y * mean_y)
    covariance = unbiased * (mean_xy - mean_x * mean_y)
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (numerator / ((mean_x.square() + mean_y.square() + c1) * (variances + c2))).permute(1, 2, 0)


def ssim_of_map(similarity: Float64[Tensor, "h w 3"]) -> float:
    """The image's SSIM: the map's mean without the border whose windows leave the image."""
    return float(similarity[BORDER:-BORDER, BORDER:-BORDER].mean())


def masked_ssim_of_map(similarity: Float64[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float | None:
    """The map of the full image averaged over the masked pixels, border included; None where the mask is empty."""
    _check_mask(mask, similarity)
    return float(similarity[mask].mean()) if bool(mask.any()) else None


def ssim(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Structural similarity of the image; 1 for identical ones. Raises ValueError for images below 7x7."""
    return ssim_of_map(ssim_map(image, truth))


def masked_ssim(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> float | None:
    """Structural similarity of the full image, averaged over the masked pixels; None where the mask is empty."""
    return masked_ssim_of_map(ssim_map(image, truth), mask)


def _window_means(stack: Float64[Tensor, "k c h w"]) -> Float64[Tensor, "k c h w"]:
    """Mean over the 7x7 pixels around each pixel, mirrored at the border with the edge pixel repeated."""
    rows, columns = (_mirrored(length, stack.device) for length in stack.shape[-2:])
    padded = stack[:, :, rows][:, :, :, columns]
    return _sliding_sums(_sliding_sums(padded, -2), -1) / WINDOW**2


def _sliding_sums(values: Float64[Tensor, "*b"], dim: int) -> Float64[Tensor, "*c"]:
    """Sums of seven neighbors along a dimension, in four additions; torch's pooling takes twice as long."""
    length = values.shape[dim] - WINDOW + 1

    def shifted(sums: Tensor, by: int, count: int) -> Tensor:
        return sums.narrow(dim, by, count)

    pairs = shifted(values, 0, length + 5) + shifted(values, 1, length + 5)
    fours = shifted(pairs, 0, length) + shifted(pairs, 2, length)
    return fours + shifted(pairs, 4, length) + shifted(values, 6, length)


def _mirrored(length: int, device: torch.device) -> Int[Tensor, " padded"]:
    """Indices ... 1 0 | 0 1 2 ... n-1 | n-1 n-2 ...; torch's "reflect" padding does not repeat the edge pixel."""
    index = torch.arange(-BORDER, length + BORDER, device=device)
    index = torch.where(index < 0, -1 - index, index)
    return torch.where(index >= length, 2 * length - 1 - index, index)


def _mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, ""]:
    _check_pair(image, truth)
    return (image.double() - truth.double()).square().mean()


def _check_pair(image: Tensor, truth: Tensor) -> None:
    if image.shape != truth.shape:
        raise ValueError(
            f"render and truth need one shape, got {tuple(image.shape)} and {tuple(truth.shape)}: "
            "render with the camera of the frame"
        )
    if image.numel() == 0:
        raise ValueError(f"an image of shape {tuple(image.shape)} has no pixels to compare")


def _check_mask(mask: Tensor, image: Tensor) -> None:
    if mask.shape != image.shape[:2]:
        raise ValueError(f"the mask is {tuple(mask.shape)}, the image {tuple(image.shape)}: resize both alike")
