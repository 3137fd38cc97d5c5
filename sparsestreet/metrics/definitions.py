"""The one place that says what each number in a record means (no torch: the report reads this too).

A metric's id is ``<quantity>_<region>``. The definitions are those of the driving-scene codebases (DriveStudio), so
that tables can be compared: renders are float32 clamped to [0, 1], not rounded to uint8; a metric is computed per
image and then averaged over images with equal weight. The choice matters: on one set of masked frames the mean of
per-image PSNRs, the PSNR of the mean MSE and the pixel-pooled PSNR lie more than 5 dB apart.
"""

REGIONS = ("full", "human", "vehicle", "near_lidar", "beyond_lidar")
QUANTITIES = ("mse", "psnr", "ssim_uniform7")

LIDAR_REACH = 0.04
"""A pixel is near the lidar where a return of the same instant falls into the square window of this fraction of the
longer image side to all four sides; the others are beyond it."""

PSNR_CAP = 100.0
"""dB; a perfectly reproduced image would otherwise make every mean infinite. Summaries count the capped images."""

_MASKED = "the pixels of the {} mask; images without the mask, or where it is empty, are skipped in the mean"
_LIDAR = (
    f"the pixels {{}} a lidar return of the same instant within {LIDAR_REACH:g} of the longer image side (a square "
    "window), moving objects included, sky left out; without a sky mask the sky counts too, mostly as beyond; images "
    "without lidar, or without such pixels, are skipped in the mean"
)
_DOMAIN = {
    "full": "all pixels of the image, the ego vehicle included",
    "human": _MASKED.format("human"),
    "vehicle": _MASKED.format("vehicle"),
    "near_lidar": _LIDAR.format("with"),
    "beyond_lidar": _LIDAR.format("without"),
}

_QUANTITY = {
    "mse": "mean squared error over pixels and RGB channels, values in [0, 1]",
    "psnr": f"-10 log10(mse) in dB, at most {PSNR_CAP:.0f}; mean of the per-image values",
    "ssim_uniform7": (
        "structural similarity with a 7x7 uniform window, data range 1, K1 = 0.01, K2 = 0.03, sample covariance, "
        "per channel (scikit-image's default; not the 11x11 Gaussian of training losses)"
    ),
}
_SSIM_DOMAIN = {
    "full": "averaged over the image less its 3 pixel border",
    "masked": "the map of the full image, borders by reflection, averaged over {region} pixels",
}


def _definition(quantity: str, region: str) -> str:
    words = [_QUANTITY[quantity], _DOMAIN[region]]
    if quantity == "ssim_uniform7":
        words.insert(1, _SSIM_DOMAIN["full" if region == "full" else "masked"].format(region=region))
    return "; ".join(words)


def metric_id(quantity: str, region: str) -> str:
    """The column name of a quantity in a region, such as ``psnr_vehicle``."""
    return f"{quantity}_{region}"


DEFINITIONS: dict[str, str] = {
    metric_id(quantity, region): _definition(quantity, region) for region in REGIONS for quantity in QUANTITIES
}
"""Id of a metric -> its definition in words; every record carries the ones it uses."""
