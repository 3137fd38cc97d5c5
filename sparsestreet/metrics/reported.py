"""Reported metrics as ``torchmetrics.Metric``s: means over images, reduced over the processes of a training.

The definitions are those of ``definitions``. torchmetrics' own PSNR, SSIM and Frechet distance are defined otherwise:
they have no masks, no cap, another border and other covariances (docs say by how much).
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torchmetrics import Metric

from sparsestreet.metrics.definitions import LPIPS_SIDES
from sparsestreet.metrics.distances import Extractor, distance_names, frechet_distance, kernel_distance
from sparsestreet.metrics.image import (
    GAUSS11,
    UNIFORM7,
    Window,
    masked_mse,
    masked_ssim_of_map,
    mse,
    psnr_of_mse,
    rounded,
    ssim_map,
    ssim_of_map,
)
from sparsestreet.metrics.lpips import Lpips, lpips_of_layers, masked_lpips_of_layers

Image = Float[Tensor, "h w 3"]
"""In [0, 1]."""
Masks = Mapping[str, Bool[Tensor, "h w"]]
"""Region -> its pixels; the region "full" needs none."""


class ImageMetric(Metric):
    """A quantity of images, by region: the mean over the images that have the region.

    Images are [h, w, 3] in [0, 1], one an update, and each value is a float64. The mean is exact before it is rounded.
    So any number of processes, in any order, give the bits of one.
    """

    full_state_update = False
    is_differentiable = False
    min_side = 1
    """Pixels; smaller images have no value."""

    def __init__(self, regions: Sequence[str] = ("full",), **options: Any) -> None:
        """``regions``: whose means ``compute`` returns; ``options``: of ``Metric``, such as ``sync_on_compute``."""
        super().__init__(**options)
        self.set_dtype(torch.float64)
        self.regions = tuple(regions)
        for region in self.regions:
            self.add_state(f"values_{region}", [], dist_reduce_fx="cat")

    def measure(self, image: Image, truth: Image, masks: Masks) -> dict[str, float | None]:
        """Return the value of one image for "full" and each mask; None for an empty mask or a small image."""
        if min(image.shape[:2]) < self.min_side:
            return dict.fromkeys(("full", *masks))
        return self._measure(image, truth, masks)

    @abstractmethod
    def _measure(self, image: Image, truth: Image, masks: Masks) -> dict[str, float | None]: ...

    def update(self, image: Image, truth: Image, masks: Masks | None = None) -> None:
        """Add an image to the means of the regions that it has."""
        for region, value in self.measure(image, truth, masks or {}).items():
            if value is not None and region in self.regions:
                getattr(self, f"values_{region}").append(torch.tensor([value], dtype=torch.float64, device=self.device))

    def compute(self) -> dict[str, float]:
        """Return region -> mean, of the regions that any image has."""
        found = {region: self._values(region) for region in self.regions}
        return {region: math.fsum(values) / len(values) for region, values in found.items() if values}

    def _values(self, region: str) -> list[float]:
        values = getattr(self, f"values_{region}")  # a list of tensors, or one tensor once processes have met
        return values.tolist() if isinstance(values, Tensor) else [float(value) for value in values]


class Psnr(ImageMetric):
    """Peak signal-to-noise ratio, dB, at most ``PSNR_CAP``."""

    higher_is_better = True

    def __init__(self, regions: Sequence[str] = ("full",), *, eight_bits: bool = False, **options: Any) -> None:
        """``eight_bits``: whether the image is rounded to 8 bits first; all else as in ``ImageMetric``."""
        super().__init__(regions, **options)
        self.eight_bits = eight_bits

    def _measure(self, image: Image, truth: Image, masks: Masks) -> dict[str, float | None]:
        errors = errors_by_region(rounded(image) if self.eight_bits else image, truth, masks)
        return {region: None if error is None else psnr_of_mse(error) for region, error in errors.items()}


class Ssim(ImageMetric):
    """Structural similarity; masks average the map of the full image."""

    higher_is_better = True

    def __init__(self, regions: Sequence[str] = ("full",), *, window: Window = UNIFORM7, **options: Any) -> None:
        """``window``: ``UNIFORM7``, or ``GAUSS11``, for which small images have no value; else as ``ImageMetric``."""
        super().__init__(regions, **options)
        self.window = window
        self.min_side = window.side if window is GAUSS11 else 1

    def _measure(self, image: Image, truth: Image, masks: Masks) -> dict[str, float | None]:
        similarity = ssim_map(image, truth, self.window)
        regions = {region: masked_ssim_of_map(similarity, mask) for region, mask in masks.items()}
        return {"full": ssim_of_map(similarity, self.window), **regions}


class PerceptualDistance(ImageMetric):
    """LPIPS; masks average the maps of the full image."""

    higher_is_better = False

    def __init__(
        self, network: Lpips, regions: Sequence[str] = ("full",), *, min_side: int = 1, **options: Any
    ) -> None:
        """
        Args:
            network: on the device of the images.
            regions: as in ``ImageMetric``.
            min_side: pixels; smaller images have no value, because the network has no last layer for them.
            options: as in ``ImageMetric``.
        """
        super().__init__(regions, **options)
        self.network, self.min_side = network, min_side

    def _measure(self, image: Image, truth: Image, masks: Masks) -> dict[str, float | None]:
        layers = self.network.layer_maps(image, truth)
        regions = {region: masked_lpips_of_layers(layers, mask) for region, mask in masks.items()}
        return {"full": lpips_of_layers(layers), **regions}


class SetDistances(Metric):
    """Frechet and kernel distance between two sets of images, by the features of an extractor.

    ``reset`` keeps the real images, as torchmetrics' FID does with ``reset_real_features=False``.
    """

    full_state_update = False
    is_differentiable = False
    higher_is_better = False

    def __init__(self, extractor: Extractor, **options: Any) -> None:
        """``extractor``: computes an image's features; ``options``: of ``torchmetrics.Metric``."""
        super().__init__(**options)
        self.set_dtype(torch.float64)
        self.extractor = extractor
        for name in ("real", "rendered"):
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, image: Image, *, real: bool) -> None:
        """Add an image in [0, 1] to the real or to the rendered ones."""
        features = torch.from_numpy(self.extractor(image)).to(self.device)
        (self.real if real else self.rendered).append(features[None])  # pyright: ignore

    def compute(self) -> dict[str, float]:
        """Return each distance by its name in records. Raises ValueError for fewer than two images in a set."""
        rendered, real = (_rows(state).cpu().numpy() for state in (self.rendered, self.real))
        frechet, kernel = distance_names(self.extractor.name)
        return {frechet: frechet_distance(rendered, real), kernel: kernel_distance(rendered, real)}

    def reset(self) -> None:
        """Forget the rendered images."""
        real = list(self.real)
        super().reset()
        self.real = real


def _rows(state: Any) -> Float[Tensor, "n d"] | Float64[Tensor, "0 0"]:
    if isinstance(state, Tensor):
        return state
    return torch.cat(state) if state else torch.zeros(0, 0, dtype=torch.float64)


def errors_by_region(image: Image, truth: Image, masks: Masks) -> dict[str, float | None]:
    """Return the mean squared error of the full image and of each mask; None where a mask is empty.

    >>> image, mask = torch.full((2, 2, 3), 0.5), torch.zeros(2, 2, dtype=torch.bool)
    >>> errors_by_region(image, torch.zeros(2, 2, 3), {"human": mask})
    {'full': 0.25, 'human': None}
    """
    return {"full": mse(image, truth)} | {region: masked_mse(image, truth, mask) for region, mask in masks.items()}


def reported_metrics(lpips: Mapping[str, Lpips], **options: Any) -> dict[str, ImageMetric]:
    """Return quantity -> metric of what every record holds; ``lpips`` are the networks that there are.

    >>> list(reported_metrics({}))
    ['psnr8', 'ssim_uniform7', 'ssim_gauss11']
    """
    return {
        "psnr8": Psnr(eight_bits=True, **options),
        "ssim_uniform7": Ssim(window=UNIFORM7, **options),
        "ssim_gauss11": Ssim(window=GAUSS11, **options),
        **{name: PerceptualDistance(network, min_side=LPIPS_SIDES[name], **options) for name, network in lpips.items()},
    }
