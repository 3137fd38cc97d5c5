"""The files a run leaves in ``<run>/records/``, for other programs as for our report (no torch import).

``quality.csv`` has one row per held-out image, ``summary.json`` everything else. Both are written whole or not at all.
"""

import csv
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.evaluation.quality import FrameQuality, MetricSummary, RegionQuality
from sparsestreet.evaluation.strict_json import RecordError, read_json, significant, write_atomically, write_json
from sparsestreet.metrics.definitions import QUANTITIES, REGIONS, metric_id

FORMAT = 1
"""Version of ``summary.json``; raised when a key changes its meaning."""


@dataclass(frozen=True)
class Latency:
    """Milliseconds per image under the protocol of ``speed.measure_latency``."""

    p50: float
    p90: float
    p99: float
    repeats: int
    warmup: int
    views: int
    """Number of different views the repeats cycle through."""
    device: str
    threads: int

    @property
    def median(self) -> float:
        """The same as p50."""
        return self.p50

    @property
    def protocol(self) -> str:
        """How the numbers were taken, in words."""
        return (
            f"{self.repeats} renders cycling through {self.views} views after {self.warmup} warm-up renders, batch 1, "
            "device synchronized, scene assembly to RGB, without loading and metrics"
        )


@dataclass(frozen=True)
class Machine:
    """What the run ran on."""

    processor: str
    cores: int
    system: str
    python: str
    torch: str


@dataclass(frozen=True)
class Source:
    """Which code ran; None outside a git checkout."""

    commit: str | None
    dirty: bool | None
    """Whether tracked files differed from the commit."""


@dataclass(frozen=True)
class RunDescription:
    """What identifies a run in a table."""

    method: str
    scene: str
    seed: int
    split: str
    """Which images are held out, in words, such as "every 10th frame from 0, test"."""
    training_seconds: float | None
    """Wall clock of training without evaluation; None where it is not known."""
    command: str


@dataclass(frozen=True)
class GuardCounts:
    """On how many rows the guards of the splat op acted (``sparsestreet.ops.Guards``), summed over the views."""

    rows: dict[str, int]
    """Name of a guard -> rows, 0 included."""
    alarms: dict[str, int]
    """Those that a clean scene never needs and that acted; empty where all is well."""

    def __post_init__(self) -> None:
        for name, count in self.alarms.items():
            if count < 1 or self.rows.get(name) != count:
                raise ValueError(f"alarms holds {name}: {count}, rows has {self.rows.get(name)}: evaluate again")


@dataclass(frozen=True)
class RunSummary:
    """The content of ``summary.json``."""

    format: int
    run: RunDescription
    images: int
    resolutions: tuple[str, ...]
    """"WIDTHxHEIGHT" of the evaluated images, each once."""
    quality: dict[str, MetricSummary]
    """Id of a metric -> its summary over the images."""
    definitions: dict[str, str]
    """Id of a metric -> what it is, in words."""
    gaussians: dict[str, int]
    """Node class -> rows, all instances, visible or not."""
    gaussians_total: int
    bytes_by_part: dict[str, int]
    bytes_total: int
    latency: Latency
    latency_protocol: str
    machine: Machine
    source: Source
    guards: GuardCounts | None = None
    """None in records from before they were counted."""

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"the record has format {self.format}, this version reads {FORMAT}: evaluate again")
        for name, parts, total in (
            ("gaussians", self.gaussians, self.gaussians_total),
            ("bytes", self.bytes_by_part, self.bytes_total),
        ):
            if sum(parts.values()) != total:
                raise ValueError(f"{name}_total is {total}, its parts sum to {sum(parts.values())}: {parts}")


def summary_path(run: Path) -> Path:
    """Where a run keeps its summary."""
    return run / "records" / "summary.json"


def quality_path(run: Path) -> Path:
    """Where a run keeps its per-image metrics."""
    return run / "records" / "quality.csv"


def write_summary(path: Path, summary: RunSummary) -> None:
    """Write ``summary.json`` atomically. Raises RecordError for values that JSON has no number for."""
    write_json(path, summary)


def read_summary(path: Path) -> RunSummary:
    """Read ``summary.json``. Raises RecordError naming the file and the entry that is wrong."""
    return read_json(path, RunSummary)


_COLUMNS = (
    *("frame", "camera", "width", "height"),
    *(metric_id(quantity, region) for region in REGIONS for quantity in ("pixels", *QUANTITIES)),
)


def write_quality(path: Path, quality: Iterable[FrameQuality]) -> None:
    """Write ``quality.csv`` atomically; a region's cells are blank where the data has no mask, and its metrics are
    blank where the mask is empty (0 pixels)."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for image in quality:
        row: list[object] = [image.frame, image.camera, image.width, image.height]
        for region in (image.full, image.human, image.vehicle):
            row += [""] * 4 if region is None else _region_cells(region, f"{path}: frame {image.frame}")
        writer.writerow(row)
    write_atomically(path, buffer.getvalue())


def read_quality(path: Path) -> list[FrameQuality]:
    """Read ``quality.csv``. Raises RecordError naming the file and the line that is wrong."""
    if not path.is_file():
        raise RecordError(f"{path}: does not exist; evaluate the run first")
    lines = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not lines or tuple(lines[0]) != _COLUMNS:
        raise RecordError(f"{path}: the header is {lines[:1]}, expected {','.join(_COLUMNS)}; evaluate the run again")
    return [_parsed(cells, f"{path}, line {number}") for number, cells in enumerate(lines[1:], start=2)]


def _region_cells(region: RegionQuality, where: str) -> list[object]:
    metrics = (region.mse, region.psnr, region.ssim_uniform7)
    return [region.pixels, *("" if value is None else significant(value, where) for value in metrics)]


def _parsed(cells: list[str], where: str) -> FrameQuality:
    if len(cells) != len(_COLUMNS):
        raise RecordError(f"{where}: {len(cells)} cells, expected {len(_COLUMNS)}")
    try:
        full, human, vehicle = (_parsed_region(cells[start : start + 4]) for start in (4, 8, 12))
        frame, camera, width, height = (int(cell) for cell in cells[:4])
    except ValueError as error:
        raise RecordError(f"{where}: {error}") from error
    if full is None:
        raise RecordError(f"{where}: the metrics of the full image are missing")
    return FrameQuality(frame, camera, width, height, full, human, vehicle)


def _parsed_region(cells: list[str]) -> RegionQuality | None:
    if not any(cells):
        return None
    values = tuple(float(cell) if cell else None for cell in cells[1:])
    if any(value is not None and not math.isfinite(value) for value in values):
        raise ValueError(f"a metric is not a finite number: {cells[1:]}")
    return RegionQuality(int(cells[0]), *values)
