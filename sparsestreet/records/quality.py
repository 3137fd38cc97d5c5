"""Image quality: values for each frame and camera, their summary over a split, and the rows of ``quality.csv``.

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
"""Names of the splits whose views are measured."""


@dataclass(frozen=True)
class RegionQuality:
    """Errors within one region of one image.

    All metrics are None if the region has no pixels. Those with defaults are also None in three cases: they are not
    defined for the region, the image is smaller than their window, or LPIPS has no weights.
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
    """The quality of one image's render."""

    frame: int
    camera: int
    width: int
    height: int
    regions: Mapping[str, RegionQuality]
    """Name of a region of ``REGIONS`` -> its quality. "full" is always there; others need a mask or lidar in the data.
    An empty region has 0 pixels."""

    def value(self, quantity: str, region: str) -> float | None:
        """Returns one metric, such as ("psnr", "vehicle"); None if the region is absent or empty."""
        found = self.regions.get(region)
        return None if found is None else getattr(found, quantity)

    def pixels(self, region: str) -> int:
        """Returns the number of pixels of a region; 0 if it is absent."""
        return self.regions[region].pixels if region in self.regions else 0


@dataclass(frozen=True)
class MetricSummary:
    """One metric over the images of a split."""

    mean: float | None
    """None if no image has the region."""
    sd: float | None
    """Sample standard deviation over images (n - 1), not over runs; None below two images."""
    images: int
    """Number of images that entered the mean."""
    capped: int
    """Number of images whose PSNR reached the cap (0 for other metrics)."""


def summarize(quality: Iterable[FrameQuality]) -> dict[str, MetricSummary]:
    """Returns id of each metric of ``DEFINITIONS`` -> its summary over the images that have the region.

    >>> image = FrameQuality(0, 0, 64, 48, {"full": RegionQuality(pixels=3072, mse=0.01, psnr=20.0, ssim_uniform7=0.8)})
    >>> summarize([image])["psnr_full"]
    MetricSummary(mean=20.0, sd=None, images=1, capped=0)
    """
    images = list(quality)
    summaries = {}
    for region in REGIONS:
        for quantity in quantities_of(region):
            values = [value for image in images if (value := image.value(quantity, region)) is not None]
            capped = sum(value >= PSNR_CAP for value in values) if quantity in ("psnr", "psnr8") else 0
            summaries[metric_id(quantity, region)] = _summary(values, capped)
    return {name: summaries[name] for name in DEFINITIONS}


def camera_means(quality: Iterable[FrameQuality]) -> dict[str, dict[str, float | None]]:
    """Returns number of a camera, in order -> id of a metric -> its mean over the camera's images with the region."""
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
    """Returns the cells of an image.

    A region's cells are blank if the data has no such mask or no lidar. Its metrics are blank if it has 0 pixels.
    """
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
    frame, camera, width, height = (int(cell) for cell in cells[:4])
    regions = {region: _region(region, named) for region in REGIONS if named[metric_id("pixels", region)]}
    image = FrameQuality(frame, camera, width, height, regions)
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
"""Split -> the file with a row for each of its images."""
