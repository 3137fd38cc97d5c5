"""Squared errors and PSNR of one image, full and masked, as defined in ``definitions``.

Images are [h, w, 3] in [0, 1]. Sums run in float64.
"""

import math

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.metrics.definitions import PSNR_CAP


def mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Mean squared error over pixels and channels. Raises ValueError if shapes differ or the image is empty.

    >>> mse(torch.full((4, 4, 3), 0.5), torch.zeros(4, 4, 3))
    0.25
    """
    return float(_mse(image, truth))


def masked_mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float | None:
    """Mean squared error over the masked pixels and all channels; None if the mask is empty.

    >>> image, mask = torch.tensor([[[0.5] * 3, [0.0] * 3]]), torch.tensor([[True, False]])
    >>> masked_mse(image, torch.zeros(1, 2, 3), mask), masked_mse(image, torch.zeros(1, 2, 3), mask & False)
    (0.25, None)
    """
    check_pair(image, truth)
    check_mask(mask, image)
    if not bool(mask.any()):
        return None
    return float((image[mask].double() - truth[mask].double()).square().mean())


def psnr_of_mse(error: float) -> float:
    """-10 log10(error) in dB, at most ``PSNR_CAP``; NaN stays NaN.

    >>> psnr_of_mse(0.01), psnr_of_mse(0.0)
    (20.0, 100.0)
    """
    return PSNR_CAP if error == 0 else min(-10 * math.log10(error), PSNR_CAP)


def psnr(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """Peak signal-to-noise ratio over all pixels, dB, at most ``PSNR_CAP``.

    >>> psnr(torch.full((4, 4, 3), 0.1, dtype=torch.float64), torch.zeros(4, 4, 3))
    20.0
    """
    return psnr_of_mse(mse(image, truth))


def psnr_on_device(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, ""]:
    """:func:`psnr` without waiting for the device, for numbers that are logged in the middle of a step.

    >>> psnr_on_device(torch.full((4, 4, 3), 0.1, dtype=torch.float64), torch.zeros(4, 4, 3)).item()
    20.0
    """
    return (-10 * _mse(image, truth).log10()).clamp(max=PSNR_CAP)


def masked_psnr(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> float | None:
    """PSNR of the masked pixels, dB; None if the mask is empty.

    >>> image, mask = torch.tensor([[[0.0] * 3, [1.0] * 3]]), torch.tensor([[False, True]])
    >>> masked_psnr(image, torch.zeros(1, 2, 3), mask), psnr(image, torch.zeros(1, 2, 3))
    (-0.0, 3.0...)
    """
    error = masked_mse(image, truth, mask)
    return None if error is None else psnr_of_mse(error)


def rounded(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The image rounded to 8 bits; values stay in [0, 1].

    >>> (rounded(torch.full((1, 1, 3), 0.5)) * 255)[0, 0].tolist()
    [128.0, 128.0, 128.0]
    """
    return (image * 255).round() / 255


def _mse(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float64[Tensor, ""]:
    check_pair(image, truth)
    return (image.double() - truth.double()).square().mean()


def check_pair(image: Tensor, truth: Tensor) -> None:
    """Raises ValueError for images of different shapes or without pixels.

    >>> check_pair(torch.zeros(4, 4, 3), torch.zeros(2, 2, 3))
    Traceback (most recent call last):
    ValueError: render and truth need one shape, got (4, 4, 3) and (2, 2, 3): render with the camera of the frame
    """
    if image.shape != truth.shape:
        raise ValueError(
            f"render and truth need one shape, got {tuple(image.shape)} and {tuple(truth.shape)}: "
            "render with the camera of the frame"
        )
    if image.numel() == 0:
        raise ValueError(f"an image of shape {tuple(image.shape)} has no pixels to compare")


def check_mask(mask: Tensor, image: Tensor) -> None:
    """Raises ValueError for a mask of another size than the image.

    >>> check_mask(torch.ones(2, 2, dtype=torch.bool), torch.zeros(4, 4, 3))
    Traceback (most recent call last):
    ValueError: the mask is (2, 2), the image (4, 4, 3): resize both alike
    """
    if mask.shape != image.shape[:2]:
        raise ValueError(f"the mask is {tuple(mask.shape)}, the image {tuple(image.shape)}: resize both alike")
