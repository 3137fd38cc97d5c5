"""The numbers of a run's table from its stored predictions and the images of its log alone: NumPy, nothing of ours."""

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, uniform_filter


def similarity(x, y, gauss):
    """SSIM per pixel and channel, in float64."""
    window: Any = (7, 7, 1)
    around = partial(gaussian_filter, sigma=(1.5, 1.5, 0), radius=5) if gauss else partial(uniform_filter, size=window)
    unbiased = 1 if gauss else 49 / 48
    mean_x, mean_y = around(x), around(y)
    variances = unbiased * (around(x * x) + around(y * y) - mean_x**2 - mean_y**2)
    covariance = unbiased * (around(x * y) - mean_x * mean_y)
    brightness = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
    return brightness * (2 * covariance + 9e-4) / (variances + 9e-4)


def recompute(run: Path, log: Path) -> dict[str, float]:
    """Id of a metric -> its mean over the held-out views."""
    values: dict[str, list[float]] = {}
    for path in sorted((run / "predictions" / "held_out").glob("*.png")):
        x = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535
        y = np.asarray(Image.open(log / "images" / f"{path.stem}.jpg")) / 255
        masks: dict[str, np.ndarray] = dict.fromkeys(("full", "no_hood"), np.ones(x.shape[:2], bool))
        for kind in ("human", "vehicle"):
            masks[kind] = np.asarray(Image.open(log / "dynamic_masks" / kind / path.name)) > 0
        rounded = np.round(x * 255) / 255
        maps = {"ssim_uniform7": (similarity(x, y, False), 3), "ssim_gauss11": (similarity(x, y, True), 5)}
        for region, mask in masks.items():
            if mask.any():
                for name, image in (("psnr", x), ("psnr8", rounded)):
                    psnr = -10 * np.log10(((image - y)[mask] ** 2).mean())
                    values.setdefault(f"{name}_{region}", []).append(psnr)
                for name, (found, edge) in maps.items():
                    inner = found[edge:-edge, edge:-edge] if region == "full" else found[mask]
                    values.setdefault(f"{name}_{region}", []).append(inner.mean())
    return {name: float(np.mean(each)) for name, each in values.items()}
