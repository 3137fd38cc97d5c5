"""The one place that says what each number in a record means (no torch, because the report reads it too).

A metric's id is ``<quantity>_<region>``. Each is computed per image, then averaged over images with equal weight. The
image is the stored prediction: the render, clamped to [0, 1] and rounded to 16 bits. ``protocols`` names the choices
of ids that tables show. The average matters: on one set of masked frames the mean of per-image PSNRs, the PSNR of the
mean MSE and the pixel-pooled PSNR lie more than 5 dB apart.
"""

from dataclasses import dataclass

REGIONS = ("full", "no_hood", "human", "vehicle", "static", "no_sky", "near_lidar", "beyond_lidar")
QUANTITIES = ("mse", "psnr", "psnr8", "ssim_uniform7", "ssim_gauss11", "lpips_alex", "lpips_vgg")

LPIPS_SIDES = {"lpips_alex": 31, "lpips_vgg": 16}
"""Least side of an image, pixels, for which each LPIPS network still has a last layer."""
GAUSS_WINDOW = 11
"""Side of the window of ``ssim_gauss11``, pixels."""

LIDAR_REACH = 0.04
"""A pixel is near the lidar if a return of the same instant lies in the square window around it, else beyond.

The window extends by this fraction of the longer image side in all four directions."""

PSNR_CAP = 100.0
"""Largest PSNR, dB: without it one perfect image would make a mean infinite. Summaries count the capped images."""

_MASKED = "the pixels of the {} mask; images without the mask, or where it is empty, are skipped in the mean"
_LIDAR = (
    f"the pixels {{}} a lidar return of the same instant within {LIDAR_REACH:g} of the longer image side (a square "
    "window), moving objects included, sky and ego vehicle left out; without a mask of these they count too, mostly as "
    "beyond; images without lidar, or without such pixels, are skipped in the mean"
)
_DOMAIN = {
    "full": "all pixels of the image, the ego vehicle included",
    "no_hood": "the pixels outside the mask of the ego vehicle; all pixels where the log has no such mask",
    "human": _MASKED.format("human"),
    "vehicle": _MASKED.format("vehicle"),
    "static": "the pixels outside the human and the vehicle mask, sky included; images without either are skipped in "
    "the mean",
    "no_sky": "the pixels outside the sky mask; images without the mask are skipped in the mean",
    "near_lidar": _LIDAR.format("with"),
    "beyond_lidar": _LIDAR.format("without"),
}

_PSNR = f"-10 log10(mse) in dB, at most {PSNR_CAP:.0f}; mean of the per-image values"
_LPIPS = (
    "learned perceptual distance of Zhang et al. 2018, version 0.1, {} features, inputs scaled from [0, 1] to [-1, 1]; "
    "lower is better; images with a side below {} pixels are skipped in the mean"
)
_QUANTITY = {
    "mse": "mean squared error over pixels and RGB channels, values in [0, 1]",
    "psnr": _PSNR,
    "psnr8": f"{_PSNR}, of the render rounded to 8 bits, as it would be saved",
    "ssim_uniform7": (
        "structural similarity with a 7x7 uniform window, data range 1, K1 = 0.01, K2 = 0.03, sample covariance, "
        "per channel (scikit-image's default; not the 11x11 Gaussian of training losses)"
    ),
    "ssim_gauss11": (
        "structural similarity with an 11x11 Gaussian window of sigma 1.5, data range 1, K1 = 0.01, K2 = 0.03, "
        "weighted covariance, per channel (Wang et al. 2004); images with a side below 11 pixels are skipped in the "
        "mean"
    ),
    "lpips_alex": _LPIPS.format("AlexNet", LPIPS_SIDES["lpips_alex"]),
    "lpips_vgg": _LPIPS.format("VGG16", LPIPS_SIDES["lpips_vgg"]),
}
_OF_MAP = "the map of the full image, borders by reflection, averaged over the region's pixels"
_LPIPS_OF_MAP = "each layer's map of the full image, brought to its size bilinearly, averaged over the region's pixels"
_FULL = {
    "ssim_uniform7": "averaged over the image less its 3 pixel border",
    "ssim_gauss11": "averaged over the image less its 5 pixel border",
    "lpips_alex": "each layer averaged over the image",
    "lpips_vgg": "each layer averaged over the image",
}
_MASKED_MAP = dict.fromkeys(("ssim_uniform7", "ssim_gauss11"), _OF_MAP) | dict.fromkeys(LPIPS_SIDES, _LPIPS_OF_MAP)

_LIDAR_QUANTITIES = ("mse", "psnr", "ssim_uniform7")
"""Quantities of the lidar regions, which are about geometry; perceptual ones are left out."""


def quantities_of(region: str) -> tuple[str, ...]:
    """The quantities measured in a region, in order.

    >>> quantities_of("near_lidar")
    ('mse', 'psnr', 'ssim_uniform7')
    """
    return _LIDAR_QUANTITIES if region in ("near_lidar", "beyond_lidar") else QUANTITIES


def _definition(quantity: str, region: str) -> str:
    words = [_QUANTITY[quantity], _DOMAIN[region]]
    averaged = (_FULL if region == "full" else _MASKED_MAP).get(quantity)
    if averaged is not None:
        words.insert(1, averaged)
    return "; ".join(words)


def metric_id(quantity: str, region: str) -> str:
    """The id of a quantity in a region.

    >>> metric_id("psnr", "vehicle")
    'psnr_vehicle'
    >>> DEFINITIONS["mse_full"]
    'mean squared error over pixels and RGB channels, values in [0, 1]; all pixels of the image, ...'
    """
    return f"{quantity}_{region}"


DEFINITIONS: dict[str, str] = {
    metric_id(quantity, region): _definition(quantity, region)
    for region in REGIONS
    for quantity in quantities_of(region)
}
"""The definition in words of each metric's id; every record carries those that it uses."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Ids of metrics by their name in a table. Raises ValueError for an id without a definition.

    >>> PROTOCOLS["strict"].psnr, PROTOCOLS["drivestudio"].psnr
    ('psnr8_no_hood', 'psnr_full')
    """

    name: str
    psnr: str
    ssim: str
    lpips: tuple[str, ...]
    human: tuple[str, str]
    """PSNR and SSIM of the pixels of people."""
    vehicle: tuple[str, str]
    """PSNR and SSIM of the pixels of vehicles."""

    def __post_init__(self) -> None:
        unknown = [metric for metric in self.metrics if metric not in DEFINITIONS]
        if unknown:
            raise ValueError(f"protocol {self.name} names {unknown}, which have no definition: see DEFINITIONS")

    @property
    def metrics(self) -> tuple[str, ...]:
        """All ids, in the order of a table."""
        return (self.psnr, self.ssim, *self.lpips, *self.human, *self.vehicle)


DRIVESTUDIO = Protocol(
    name="drivestudio",
    psnr="psnr_full",
    ssim="ssim_uniform7_full",
    lpips=("lpips_alex_full",),
    human=("psnr_human", "ssim_uniform7_human"),
    vehicle=("psnr_vehicle", "ssim_uniform7_vehicle"),
)
"""The metrics of DriveStudio, to compare with its tables and the paper's: without rounding, the hood included."""

STRICT = Protocol(
    name="strict",
    psnr="psnr8_no_hood",
    ssim="ssim_gauss11_no_hood",
    lpips=("lpips_alex_no_hood", "lpips_vgg_no_hood"),
    human=("psnr8_human", "ssim_gauss11_human"),
    vehicle=("psnr8_vehicle", "ssim_gauss11_vehicle"),
)
"""What a viewer sees: 8 bits, without the recording car; SSIM with its paper's window, and both LPIPS."""

PROTOCOLS = {protocol.name: protocol for protocol in (DRIVESTUDIO, STRICT)}
