"""Errors of an image and its gradients against a truth in float64."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.bench.timing import GROUPS, Cotangent, leaves
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.splat import splat
from sparsestreet.types import Camera, Gaussians

MIN_PSNR = 60.0
"""Least PSNR of agreement, dB. Fast-math exponentials move a sample over the cut-off 1/255 in some pixels.

If every thousandth pixel changed by 1/255, PSNR would be 78 dB."""
MAX_GRADIENT_ERROR = 5e-3
"""Largest relative L2 of a group. gsplat recovers transmittance by dividing: errors to 2e-3 in saturated pixels."""


@dataclass(frozen=True)
class Answer:
    """An image and the gradients of its parameters under a fixed random cotangent; float64, on the CPU."""

    image: Float[Tensor, "h w 3"]
    gradients: dict[str, Tensor]


@dataclass(frozen=True)
class ImageError:
    """Differences of colors in [0, 1], over black."""

    maximum: float
    mean: float
    psnr: float | None
    """dB for a peak of 1; None: the images are equal."""


@dataclass(frozen=True)
class GradientError:
    """Differences of one parameter group's gradients."""

    relative_l2: float | None
    """|g - g*| / |g*| over all rows; None: the truth is zero and the answer is not."""
    percentile_999: float | None
    """99.9th percentile over rows of |g_i - g*_i|, in units of the root mean square of |g*_i|."""


@dataclass(frozen=True)
class Errors:
    """One answer against one truth."""

    image: ImageError
    gradients: dict[str, GradientError]


def answer(
    gaussians: Gaussians, camera: Camera, settings: SplatSettings, backend: str, dtype: torch.dtype, device: str = "cpu"
) -> Answer:
    """Render and differentiate once."""
    rows = leaves(gaussians, dtype, device)
    rendering = splat(rows, camera, settings=settings, backend=backend)
    Cotangent.of(camera, rows.means).backward(rendering.rgb, rendering.alpha)
    return collect(rendering.rgb, rows)


def collect(image: Tensor, rows: Gaussians) -> Answer:
    """An image and the gradients its leaves have collected."""
    gradients = {name: getattr(rows, name).grad.detach().double().cpu() for name in GROUPS}
    return Answer(image.detach().double().cpu(), gradients)


def errors(value: Answer, truth: Answer) -> Errors:
    """Image and gradient errors of ``value``."""
    gradients = {name: gradient_error(value.gradients[name], truth.gradients[name]) for name in truth.gradients}
    return Errors(image_error(value.image, truth.image), gradients)


def image_error(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> ImageError:
    """Largest and mean absolute difference, and PSNR = -10 log10(mean squared difference)."""
    difference = image - truth
    square = float(difference.square().mean())
    psnr = None if square == 0 else -10 * math.log10(square)
    return ImageError(float(difference.abs().max()), float(difference.abs().mean()), psnr)


def gradient_error(gradient: Tensor, truth: Tensor) -> GradientError:
    """Errors over a whole group, and what its worst thousandth of rows exceeds."""
    difference = (gradient - truth).flatten(1) if truth.dim() > 1 else (gradient - truth)[:, None]
    whole, scale = float(difference.norm()), float(truth.norm())
    if scale == 0:
        return GradientError(0.0, 0.0) if whole == 0 else GradientError(None, None)
    rows = difference.norm(dim=1)
    # kthvalue, because torch.quantile refuses more than 2^24 rows.
    worst = float(rows.kthvalue(max(1, math.ceil(0.999 * len(rows)))).values)
    return GradientError(whole / scale, worst / (scale / math.sqrt(len(rows))))


def agrees(error: Errors) -> bool:
    """Tell whether images and gradients of two float32 renderers agree within MIN_PSNR and MAX_GRADIENT_ERROR."""
    if error.image.psnr is not None and error.image.psnr < MIN_PSNR:
        return False
    groups = [group.relative_l2 for group in error.gradients.values()]
    return all(value is not None and value <= MAX_GRADIENT_ERROR for value in groups)
