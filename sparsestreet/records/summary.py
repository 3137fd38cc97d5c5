"""``records/summary.json``: the identity of a run and its measurements, for other programs and for our report.

Training writes ``RUN/run.json`` once. Each evaluation writes ``RUN/records/summary.json``, which holds the content of
the former unchanged. Both are written whole or not at all.
"""

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field

from sparsestreet.metrics.definitions import DEFINITIONS, PSNR_CAP, REGIONS, metric_id, quantities_of
from sparsestreet.records.file import CsvFile, JsonFile
from sparsestreet.records.geometry import Geometry
from sparsestreet.records.run import CodeVersion, Machine, Noise, RunDescription
from sparsestreet.records.strict_json import significant, version

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
        """Return one metric, such as ("psnr", "vehicle"); None if the region is absent or empty."""
        found = self.regions.get(region)
        return None if found is None else getattr(found, quantity)

    def pixels(self, region: str) -> int:
        """Return the number of pixels of a region; 0 if it is absent."""
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
    """Return id of each metric of ``DEFINITIONS`` -> its summary over the images that have the region.

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
    """Return number of a camera, in order -> id of a metric -> its mean over the camera's images with the region."""
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
    """Return the cells of an image.

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


RASTER, FRAME, RIG = "raster", "frame", "rig"
"""Names of the clocks. ``RASTER`` times the splat op alone. ``FRAME`` times everything from a time and a pose to a
uint8 image on the device. ``RIG`` times that for all cameras of an instant."""


@dataclass(frozen=True)
class Percentiles:
    """Percentiles of repeated times, milliseconds."""

    p50: float
    p90: float
    p99: float
    repeats: int


@dataclass(frozen=True)
class Latency:
    """Milliseconds by three clocks under the protocol of ``speed.measure_latency``."""

    clocks: dict[str, Percentiles]
    """Clock -> its times for the scene as stored; Gaussians that a mask closes are masked."""
    removed: dict[str, Percentiles]
    """The same after removing the Gaussians that the masks close at the time of the view; empty without masks."""
    warmup: int
    views: int
    """Number of different views that the repeats cycle through."""
    device: str
    threads: int
    noise: Noise

    def __post_init__(self) -> None:
        if set(self.clocks) != {RASTER, FRAME, RIG} or set(self.removed) not in (set(), set(self.clocks)):
            raise ValueError(
                f"a latency has the clocks {RASTER}, {FRAME}, {RIG}, got {sorted(self.clocks)} and, of removed "
                f"Gaussians, {sorted(self.removed)}: evaluate again"
            )

    @property
    def p50(self) -> float:
        """Median of a frame, milliseconds."""
        return self.clocks[FRAME].p50

    @property
    def protocol(self) -> str:
        """Say in words how the median of a frame was taken."""
        return (
            f"{self.clocks[FRAME].repeats} renders cycling through {self.views} views after {self.warmup} warm-up "
            "renders, batch 1, device synchronized, scene assembly to uint8, without loading and metrics"
        )


@dataclass(frozen=True)
class ClockRow:
    """A clock with the kind of Gaussians that it timed."""

    clock: str
    gaussians: str
    """"all" without masks. With masks: "masked" for all Gaussians, closed ones included, or "removed" for open ones."""
    percentiles: Percentiles


def clock_rows(latency: Latency) -> Iterator[ClockRow]:
    """Yield a row for each clock."""
    for gaussians, clocks in (("masked" if latency.removed else "all", latency.clocks), ("removed", latency.removed)):
        for clock, percentiles in clocks.items():
            yield ClockRow(clock, gaussians, percentiles)


def _cells_latency(row: ClockRow) -> Sequence[object]:
    *times, repeats = astuple(row.percentiles)
    return row.clock, row.gaussians, *(significant(value, row.clock) for value in times), repeats


def _row(cells: Sequence[str]) -> ClockRow:
    clock, gaussians, p50, p90, p99, repeats = cells
    return ClockRow(clock, gaussians, Percentiles(float(p50), float(p90), float(p99), int(repeats)))


LATENCY = CsvFile(
    "records/latency.csv", ("clock", "rows", "p50", "p90", "p99", "repeats"), _cells_latency, _row, "evaluate the run"
)


FORMAT = 4
"""Version of ``summary.json``; raised when a key changes its meaning."""


@dataclass(frozen=True)
class Evaluation:
    """The command, machine and code that measured a run."""

    command: str
    machine: Machine
    source: CodeVersion
    device: str
    threads: int


@dataclass(frozen=True)
class GuardCounts:
    """Number of Gaussians that the guards of the splat op acted on (``sparsestreet.ops.Guards``), summed over views."""

    rows: dict[str, int]
    """Name of a guard -> Gaussians, 0 included."""
    alarms: dict[str, int]
    """The guards that acted although a clean scene never needs them; empty if all is well."""

    def __post_init__(self) -> None:
        for name, count in self.alarms.items():
            if count < 1 or self.rows.get(name) != count:
                raise ValueError(f"alarms holds {name}: {count}, rows has {self.rows.get(name)}: evaluate again")


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The content of ``summary.json``."""

    format: int = version(FORMAT, "evaluate again")
    run: RunDescription
    evaluated: Evaluation
    timed: Evaluation | None = None
    """The command, machine and code of ``latency``, where the frames were timed once more; None: those above."""
    images: dict[str, int]
    """Split ("held_out", "training") -> number of its evaluated images; a split without views is absent."""
    resolutions: tuple[str, ...]
    """The different sizes of the evaluated images, as "WIDTHxHEIGHT"."""
    quality: dict[str, dict[str, MetricSummary]]
    """Split -> id of a metric -> its summary over the split's images."""
    by_camera: dict[str, dict[str, dict[str, float | None]]]
    """Split -> number of a camera -> id of a metric -> its mean over the split's images of that camera."""
    definitions: dict[str, str]
    """Id of a metric -> its definition in words."""
    absent: dict[str, str]
    """Quantity that could not be measured, such as "lpips_alex" -> why, and what to do about it."""
    gaussians: dict[str, int]
    """Node -> number of Gaussians of all its instances, visible or not."""
    gaussians_total: int
    bytes_by_part: dict[str, int]
    bytes_total: int
    latency: Latency
    """Times over the views of ``main_split``, on the device that it names."""
    latency_protocol: str
    guards: GuardCounts
    """Counts over the views of ``main_split``."""
    geometry: Geometry | None = None
    """Errors of ranges along lidar rays; None without lidar, of one that is not told where it stood, and in records of
    earlier versions."""

    def __post_init__(self) -> None:
        splits = [sorted(part) for part in (self.quality, self.by_camera, self.images)]
        if splits[0] not in ([HELD_OUT], [TRAINING], [HELD_OUT, TRAINING]) or splits != 3 * splits[:1]:
            raise ValueError(
                f"quality speaks of the splits {splits[0]}, by_camera of {splits[1]} and images of {splits[2]}, "
                f"expected {HELD_OUT}, {TRAINING} or both in all: evaluate again"
            )
        for name, parts, total in (
            ("gaussians", self.gaussians, self.gaussians_total),
            ("bytes", self.bytes_by_part, self.bytes_total),
        ):
            if sum(parts.values()) != total:
                raise ValueError(f"{name}_total is {total}, its parts sum to {sum(parts.values())}: {parts}")

    @property
    def main_split(self) -> str:
        """The held-out split, or the training split of a run that holds out no views."""
        return HELD_OUT if HELD_OUT in self.quality else TRAINING

    @property
    def timing(self) -> Evaluation:
        """The command, machine and code that timed the frames."""
        return self.timed or self.evaluated

    def mean(self, metric: str, split: str | None = None) -> float | None:
        """Return the mean of a metric over the images of a split (default ``main_split``); None if not measured."""
        found = self.quality.get(split or self.main_split, {}).get(metric)
        return None if found is None else found.mean

    def mean_of_all(self, metric: str) -> float | None:
        """Return the mean of a metric over training and held-out images together, each with its region counting once.

        None without such images, and where some of them lack the metric, as LPIPS is mostly left out of training views.
        """
        region = next(region for region in REGIONS if metric.endswith(f"_{region}"))
        parts = [(split.get(metric), split.get(metric_id("psnr", region))) for split in self.quality.values()]
        found = [one for one, of_region in parts if one and of_region and one.images == of_region.images]
        images = sum(one.images for one in found)
        if len(found) < len(parts) or not images:
            return None
        return math.fsum(one.images * one.mean for one in found if one.mean is not None) / images


SUMMARY = JsonFile("records/summary.json", RunSummary)


NOVEL_FORMAT = 2
"""Version of ``novel.json``; raised when a key changes its meaning."""

TRUTH = ("psnr_full", "psnr_human", "psnr_vehicle", "lpips_alex")
"""Metrics that compare a render with the true image: PSNR of all pixels, of people, of vehicles, in dB; LPIPS."""


@dataclass(frozen=True, kw_only=True)
class NovelShift:
    """One path parallel to the recorded one."""

    offset: float
    """Meters to the right of the rig; negative to the left."""
    views: int
    """Number of renders that are compared with the real images."""
    distances: dict[str, float]
    """Name of a distance, such as "frechet_alexnet" -> its value; empty if none could be measured."""
    truth: dict[str, float]
    """Some of ``TRUTH`` -> mean over the true images that have such pixels; empty without true images."""
    true_views: int
    """Number of true images. A view whose camera lies inside an object has none."""

    def __post_init__(self) -> None:
        unknown = sorted(self.truth.keys() - set(TRUTH))
        if unknown:
            raise ValueError(f"truth holds {', '.join(unknown)}, expected {', '.join(TRUTH)} alone: evaluate again")


@dataclass(frozen=True, kw_only=True)
class NovelRecord:
    """The content of ``novel.json``."""

    format: int = version(NOVEL_FORMAT, "evaluate again with novel=...")
    command: str
    ramp: bool
    """Whether the shift grows from 0 at the first instant to its full value at the last, as in a change of lane."""
    real_views: int
    """Number of real images, those of the recorded views that are shifted."""
    absent: str | None
    """Why there are no distances, and what to do about it; None if there are some."""
    missing: dict[str, str] = field(default_factory=dict)
    """Distance that could not be measured, such as "fid" -> why, and what to do about it."""
    shifts: tuple[NovelShift, ...]


NOVEL = JsonFile("records/novel.json", NovelRecord)


PRESETS_FORMAT = 1
"""Version of ``presets.json``; raised when a key changes its meaning."""


@dataclass(frozen=True, kw_only=True)
class RenderedAs:
    """One way to render the scene, measured on the same views as the record's other ways."""

    preset: str
    """Name of the settings, as in ``render.preset``."""
    trained: bool
    """Whether training rendered with the same settings."""
    quality: dict[str, float]
    """Id of a metric of ``DEFINITIONS`` -> its mean over the views that have it."""
    psnr_to_exact: float
    """PSNR against the same scene rendered without cut-off and early stop: mean over the views, dB."""
    frame_ms: float
    """Median milliseconds from a time and a pose to a uint8 image. The presets of a record were timed in turn at each
    view, so times compare better within a record than between records."""
    repeats: int
    """Number of timed frames."""


@dataclass(frozen=True, kw_only=True)
class PresetRecord:
    """The content of ``presets.json``."""

    format: int = version(PRESETS_FORMAT, "evaluate again with presets=...")
    command: str
    device: str
    threads: int
    views: int
    noise: Noise
    rendered: tuple[RenderedAs, ...]


PRESETS = JsonFile("records/presets.json", PresetRecord)
