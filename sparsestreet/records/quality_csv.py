"""``quality.csv`` and ``quality_train.csv``: a row per image, read back by one validated reader (no torch)."""

import csv
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from sparsestreet.metrics.definitions import REGIONS, metric_id, quantities_of
from sparsestreet.records.quality import FrameQuality, RegionQuality
from sparsestreet.records.strict_json import RecordError, significant, write_atomically
from sparsestreet.records.summary import HELD_OUT, TRAINING

_FILES = {HELD_OUT: "quality.csv", TRAINING: "quality_train.csv"}

_COLUMNS = (
    *("frame", "camera", "width", "height"),
    *(metric_id(quantity, region) for region in REGIONS for quantity in ("pixels", *quantities_of(region))),
)


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
            row += _region_cells(region, image, f"{path}: frame {image.frame}")
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


def _region_cells(region: str, image: FrameQuality, where: str) -> list[object]:
    names = quantities_of(region)
    found = image.regions.get(region)
    if found is None:
        return [""] * (1 + len(names))
    values = [getattr(found, name) for name in names]
    return [found.pixels, *("" if value is None else significant(value, where) for value in values)]


def _parsed(cells: list[str], where: str) -> FrameQuality:
    if len(cells) != len(_COLUMNS):
        raise RecordError(f"{where}: {len(cells)} cells, expected {len(_COLUMNS)}")
    try:
        named = dict(zip(_COLUMNS, cells, strict=True))
        numbers = (int(cell) for cell in cells[:4])
        regions = {region: _parsed_region(region, named) for region in REGIONS if named[metric_id("pixels", region)]}
        image = FrameQuality(*numbers, regions)
    except ValueError as error:
        raise RecordError(f"{where}: {error}") from error
    if "full" not in regions:
        raise RecordError(f"{where}: the metrics of the full image are missing")
    return image


def _parsed_region(region: str, cells: Mapping[str, str]) -> RegionQuality:
    texts = {name: cells[metric_id(name, region)] for name in quantities_of(region)}
    values = {name: float(text) if text else None for name, text in texts.items()}
    if any(value is not None and not math.isfinite(value) for value in values.values()):
        raise ValueError(f"a metric is not a finite number: {list(texts.values())}")
    return RegionQuality(int(cells[metric_id("pixels", region)]), **values)
