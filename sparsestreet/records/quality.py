"""How good images are: one value per frame and camera, their summary over a split, and the rows of ``quality.csv``.

The summary takes means over images, never over pixels; see ``metrics.definitions``.
"""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sparsestreet.metrics.definitions import DEFINITIONS, PSNR_CAP, REGIONS, metric_id, quantities_of
from sparsestreet.records.file import CsvFile
from sparsestreet.records.strict_json import significant

HELD_OUT, TRAINING = "held_out", "training"
"""The splits whose views a record speaks of."""


@dataclass(frozen=True)
class RegionQuality:
    """Errors within one region of one image.

    All metrics are None where the region has no pixels; those with defaults also where they are not defined for the
    region, the image is below their window, or LPIPS has no weights.
    """

    pixels: int
    mse: float | None
    psnr: float | None
    """dB."""
    ssim_uniform7: float | None
    psnr8: float | None = None
    """dB."""
    ssim_gauss11: float | None = None
    lpips_alex: float | None = None
    lpips_vgg: float | None = None


@dataclass(frozen=True)
class FrameQuality:
    """One held-out image compared with its render."""

    frame: int
    camera: int
    width: int
    height: int
    regions: Mapping[str, RegionQuality]
    """Name, of ``REGIONS`` -> its quality: "full" always; others where the data has such a mask, or lidar, with 0
    pixels where the region is empty."""

    def value(self, quantity: str, region: str) -> float | None:
        """One metric, such as ("psnr", "vehicle"); None where the region is absent or empty."""
        found = self.regions.get(region)
        return None if found is None else getattr(found, quantity)

    def pixels(self, region: str) -> int:
        """Number of pixels of a region; 0 where it is absent."""
        return self.regions[region].pixels if region in self.regions else 0


@dataclass(frozen=True)
class MetricSummary:
    """One metric over the images of a split."""

    mean: float | None
    """None where no image has the region."""
    sd: float | None
    """Sample standard deviation over images (n - 1); None below two images. Not the spread over runs."""
    images: int
    """Number of images that entered the mean."""
    capped: int
    """Number of images whose PSNR was cut off at the cap (0 for other metrics)."""


def summarize(quality: Iterable[FrameQuality]) -> dict[str, MetricSummary]:
    """Id of each metric of ``DEFINITIONS`` -> its mean over the images that have the region."""
    images = list(quality)
    summaries = {}
    for region in REGIONS:
        for quantity in quantities_of(region):
            values = [value for image in images if (value := image.value(quantity, region)) is not None]
            capped = sum(value >= PSNR_CAP for value in values) if quantity in ("psnr", "psnr8") else 0
            summaries[metric_id(quantity, region)] = _summary(values, capped)
    return {name: summaries[name] for name in DEFINITIONS}


def camera_means(quality: Iterable[FrameQuality]) -> dict[str, dict[str, float | None]]:
    """Number of each camera, in order -> id of each metric -> its mean over the camera's images with the region."""
    images = list(quality)
    return {
        str(camera): {
            name: one.mean for name, one in summarize(image for image in images if image.camera == camera).items()
        }
        for camera in sorted({image.camera for image in images})
    }


def _summary(values: list[float], capped: int) -> MetricSummary:
    mean = statistics.fmean(values) if values else None
    sd = statistics.stdev(values) if len(values) > 1 else None
    return MetricSummary(mean, sd, len(values), capped)


_COLUMNS = (
    *("frame", "camera", "width", "height"),
    *(metric_id(quantity, region) for region in REGIONS for quantity in ("pixels", *quantities_of(region))),
)


def _cells(image: FrameQuality) -> Sequence[object]:
    """A region's cells are blank where the data has no such mask or no lidar, and its metrics are blank where the
    region is empty (0 pixels)."""
    regions = [cell for region in REGIONS for cell in _region_cells(region, image)]
    return image.frame, image.camera, image.width, image.height, *regions


def _region_cells(region: str, image: FrameQuality) -> list[object]:
    names = quantities_of(region)
    found = image.regions.get(region)
    if found is None:
        return [None] * (1 + len(names))
    values = [getattr(found, name) for name in names]
    where = f"frame {image.frame}"
    return [found.pixels, *(None if value is None else significant(value, where) for value in values)]


def _image(cells: Sequence[str]) -> FrameQuality:
    named = dict(zip(_COLUMNS, cells, strict=True))
    numbers = (int(cell) for cell in cells[:4])
    regions = {region: _region(region, named) for region in REGIONS if named[metric_id("pixels", region)]}
    image = FrameQuality(*numbers, regions)
    if "full" not in regions:
        raise ValueError("the metrics of the full image are missing")
    return image


def _region(region: str, cells: Mapping[str, str]) -> RegionQuality:
    texts = {name: cells[metric_id(name, region)] for name in quantities_of(region)}
    values = {name: float(text) if text else None for name, text in texts.items()}
    if any(value is not None and not math.isfinite(value) for value in values.values()):
        raise ValueError(f"a metric is not a finite number: {list(texts.values())}")
    return RegionQuality(int(cells[metric_id("pixels", region)]), **values)


QUALITY = {
    split: CsvFile(f"records/{name}", _COLUMNS, _cells, _image, "evaluate the run")
    for split, name in ((HELD_OUT, "quality.csv"), (TRAINING, "quality_train.csv"))
}
"""Split -> the file of its images, a row each."""
