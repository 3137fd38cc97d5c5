"""Squared errors and PSNR of one image, full and masked, as defined in ``definitions``.

Images are [h, w, 3] in [0, 1]. Sums run in float64.
"""

import math

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.metrics.definitions import PSNR_CAP


def mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Mean squared error over pixels and channels. Raises ValueError if shapes differ or the image is empty."""
    return float(_mse(image, truth))


def masked_mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float | None:
    """Mean squared error over the masked pixels and channels; None where the mask is empty."""
    check_pair(image, truth)
    check_mask(mask, image)
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


def rounded(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The image as 8 bits would hold it; values in [0, 1]."""
    return (image * 255).round() / 255


def _mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, ""]:
    check_pair(image, truth)
    return (image.double() - truth.double()).square().mean()


def check_pair(image: Tensor, truth: Tensor) -> None:
    """Raises ValueError for images of different shapes or without pixels."""
    if image.shape != truth.shape:
        raise ValueError(
            f"render and truth need one shape, got {tuple(image.shape)} and {tuple(truth.shape)}: "
            "render with the camera of the frame"
        )
    if image.numel() == 0:
        raise ValueError(f"an image of shape {tuple(image.shape)} has no pixels to compare")


def check_mask(mask: Tensor, image: Tensor) -> None:
    """Raises ValueError for a mask of another size than the image."""
    if mask.shape != image.shape[:2]:
        raise ValueError(f"the mask is {tuple(mask.shape)}, the image {tuple(image.shape)}: resize both alike")
