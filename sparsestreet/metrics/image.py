"""Squared errors, PSNR and structural similarity of one image, full and masked, as defined in ``definitions``.

Images are [h, w, 3] in [0, 1]. Sums run in float64: in float32 the rounding errors of a flat sky's variance,
E[x^2] - E[x]^2, matter next to SSIM's small constants."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sparsestreet.metrics.definitions import GAUSS_WINDOW, PSNR_CAP


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
    """Raise ValueError for images of different shapes or without pixels.

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
    """Raise ValueError for a mask of another size than the image.

    >>> check_mask(torch.ones(2, 2, dtype=torch.bool), torch.zeros(4, 4, 3))
    Traceback (most recent call last):
    ValueError: the mask is (2, 2), the image (4, 4, 3): resize both alike
    """
    if mask.shape != image.shape[:2]:
        raise ValueError(f"the mask is {tuple(mask.shape)}, the image {tuple(image.shape)}: resize both alike")


@dataclass(frozen=True)
class Window:
    """Separable weights around each pixel; they sum to 1."""

    weights: tuple[float, ...]
    bessel: float
    """Factor of variances: n / (n - 1) for n equal weights gives the sample variance."""

    @property
    def side(self) -> int:
        return len(self.weights)

    @property
    def border(self) -> int:
        return self.side // 2


def _gaussian(side: int, sigma: float) -> tuple[float, ...]:
    weights = [math.exp(-0.5 * ((place - side // 2) / sigma) ** 2) for place in range(side)]
    return tuple(weight / sum(weights) for weight in weights)


UNIFORM7 = Window((1 / 7,) * 7, 49 / 48)
"""scikit-image's default."""
GAUSS11 = Window(_gaussian(GAUSS_WINDOW, 1.5), 1.0)
"""Wang et al. 2004."""


def ssim_map(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], window: Window = UNIFORM7
) -> Float64[Tensor, "h w 3"]:
    """Structural similarity per pixel and channel (Wang et al. 2004).

    ((2 ux uy + C1)(2 vxy + C2)) / ((ux^2 + uy^2 + C1)(vx + vy + C2)) with C1 = 0.01^2, C2 = 0.03^2 and statistics
    over the window. Outside the image the pixels are mirrored, the edge pixel included.
    Raises ValueError for images with a side below the window's.

    >>> black, white = torch.zeros(8, 8, 3), torch.ones(8, 8, 3)
    >>> ssim_map(black, white)[0, 0]  # without variance C1 / (1 + C1) is left
    tensor([9.9990e-05, 9.9990e-05, 9.9990e-05], dtype=torch.float64)
    """
    check_pair(image, truth)
    if min(image.shape[:2]) < window.side:
        raise ValueError(
            f"SSIM needs images of at least {window.side}x{window.side} pixels, got {image.shape[1]}x{image.shape[0]}: "
            "evaluate at a higher resolution"
        )
    x, y = image.double().permute(2, 0, 1), truth.double().permute(2, 0, 1)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = _window_means(torch.stack((x, y, x * x, y * y, x * y)), window)
    variances = window.bessel * (mean_xx - mean_x * mean_x + mean_yy - mean_y * mean_y)
    covariance = window.bessel * (mean_xy - mean_x * mean_y)
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    return (numerator / ((mean_x.square() + mean_y.square() + c1) * (variances + c2))).permute(1, 2, 0)


def ssim_of_map(similarity: Float64[Tensor, "h w 3"], window: Window = UNIFORM7) -> float:
    """SSIM of the image: the map's mean without the border, where windows leave the image.

    >>> similarity = torch.zeros(8, 8, 3, dtype=torch.float64)
    >>> similarity[3:-3, 3:-3] = 0.5  # a 7x7 window leaves the image in a border of 3 pixels
    >>> ssim_of_map(similarity)
    0.5
    """
    border = window.border
    return float(similarity[border:-border, border:-border].mean())


def masked_ssim_of_map(similarity: Float64[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float | None:
    """The map of the full image averaged over the masked pixels, border included; None if the mask is empty.

    >>> similarity = torch.zeros(2, 2, 3, dtype=torch.float64)
    >>> similarity[0, 0] = 1.0
    >>> masked_ssim_of_map(similarity, torch.tensor([[True, True], [False, False]]))
    0.5
    """
    check_mask(mask, similarity)
    return float(similarity[mask].mean()) if bool(mask.any()) else None


def _window_means(stack: Float64[Tensor, "k c h w"], window: Window) -> Float64[Tensor, "k c h w"]:
    """Weighted mean around each pixel; the border is mirrored with the edge pixel repeated."""
    rows, columns = (_mirrored(length, window.border, stack.device) for length in stack.shape[-2:])
    padded = stack[:, :, rows][:, :, :, columns]
    means = _sevens if window is UNIFORM7 else _weighted
    return means(means(padded, -2, window), -1, window)


def _weighted(values: Float64[Tensor, "*b"], dim: int, window: Window) -> Float64[Tensor, "*c"]:
    """Weighted sums of neighbors along a dimension; two neighbors of equal weight are added first."""
    length = values.shape[dim] - window.side + 1
    parts = [values.narrow(dim, place, length) for place in range(window.side)]
    sums = window.weights[window.border] * parts[window.border]
    for near, weight in enumerate(window.weights[: window.border]):
        sums.add_(parts[near] + parts[-1 - near], alpha=weight)
    return sums


def _sevens(values: Float64[Tensor, "*b"], dim: int, window: Window) -> Float64[Tensor, "*c"]:
    """Means of seven neighbors along a dimension, in four additions; torch's pooling takes twice as long."""
    length = values.shape[dim] - window.side + 1

    def shifted(sums: Tensor, by: int, count: int) -> Tensor:
        return sums.narrow(dim, by, count)

    pairs = shifted(values, 0, length + 5) + shifted(values, 1, length + 5)
    fours = shifted(pairs, 0, length) + shifted(pairs, 2, length)
    return (fours + shifted(pairs, 4, length) + shifted(values, 6, length)) / window.side


def _mirrored(length: int, border: int, device: torch.device) -> Int[Tensor, " padded"]:
    """Indices ... 1 0 | 0 1 2 ... n-1 | n-1 n-2 ...; torch's "reflect" padding does not repeat the edge pixel."""
    index = torch.arange(-border, length + border, device=device)
    index = torch.where(index < 0, -1 - index, index)
    return torch.where(index >= length, 2 * length - 1 - index, index)
