"""``quality.csv`` and ``quality_train.csv``: a row per image, read back by one validated reader (no torch)."""

import csv
import io
import math
from collections.abc import Iterable
from pathlib import Path

from sparsestreet.evaluation.quality import FrameQuality, RegionQuality
from sparsestreet.evaluation.records import HELD_OUT, TRAINING
from sparsestreet.evaluation.strict_json import RecordError, significant, write_atomically
from sparsestreet.metrics.definitions import QUANTITIES, REGIONS, metric_id

_FILES = {HELD_OUT: "quality.csv", TRAINING: "quality_train.csv"}

_COLUMNS = (
    *("frame", "camera", "width", "height"),
    *(metric_id(quantity, region) for region in REGIONS for quantity in ("pixels", *QUANTITIES)),
)
_REGION_CELLS = 1 + len(QUANTITIES)


def quality_path(run: Path, split: str = HELD_OUT) -> Path:
    """Where a run keeps the per-image metrics of its held-out or training views."""
    return run / "records" / _FILES[split]


def write_quality(path: Path, quality: Iterable[FrameQuality]) -> None:
    """Write one row per image atomically; a region's cells are blank where the data has no such mask or no lidar, and
    its metrics are blank where the region is empty (0 pixels)."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for image in quality:
        row: list[object] = [image.frame, image.camera, image.width, image.height]
        for region in REGIONS:
            row += _region_cells(image.regions.get(region), f"{path}: frame {image.frame}")
        writer.writerow(row)
    write_atomically(path, buffer.getvalue())


def read_quality(path: Path) -> list[FrameQuality]:
    """Read the rows back. Raises RecordError naming the file and the line that is wrong."""
    if not path.is_file():
        raise RecordError(f"{path}: does not exist; evaluate the run first")
    lines = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not lines or tuple(lines[0]) != _COLUMNS:
        raise RecordError(f"{path}: the header is {lines[:1]}, expected {','.join(_COLUMNS)}; evaluate the run again")
    return [_parsed(cells, f"{path}, line {number}") for number, cells in enumerate(lines[1:], start=2)]


def _region_cells(region: RegionQuality | None, where: str) -> list[object]:
    if region is None:
        return [""] * _REGION_CELLS
    metrics = (region.mse, region.psnr, region.ssim_uniform7)
    return [region.pixels, *("" if value is None else significant(value, where) for value in metrics)]


def _parsed(cells: list[str], where: str) -> FrameQuality:
    if len(cells) != len(_COLUMNS):
        raise RecordError(f"{where}: {len(cells)} cells, expected {len(_COLUMNS)}")
    try:
        numbers = (int(cell) for cell in cells[:4])
        parts = (cells[start : start + _REGION_CELLS] for start in range(4, len(cells), _REGION_CELLS))
        regions = {name: _parsed_region(part) for name, part in zip(REGIONS, parts, strict=True) if any(part)}
        image = FrameQuality(*numbers, regions)
    except ValueError as error:
        raise RecordError(f"{where}: {error}") from error
    if "full" not in regions:
        raise RecordError(f"{where}: the metrics of the full image are missing")
    return image


def _parsed_region(cells: list[str]) -> RegionQuality:
    values = tuple(float(cell) if cell else None for cell in cells[1:])
    if any(value is not None and not math.isfinite(value) for value in values):
        raise ValueError(f"a metric is not a finite number: {cells[1:]}")
    return RegionQuality(int(cells[0]), *values)
