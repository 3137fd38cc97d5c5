"""Measurements next to the recorded path (``records/novel.json``): distances to real images, and to the truth."""

import statistics
from collections.abc import Sequence
from pathlib import Path

from sparsestreet.records.novel import NOVEL
from sparsestreet.report.arms import Arm, mean_over_scenes
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.grid import Cell, Grid

TRUTH = {
    "psnr_full": "PSNR to the truth, dB",
    "psnr_human": "PSNR of people, dB",
    "psnr_vehicle": "PSNR of vehicles, dB",
    "lpips_alex": "LPIPS (AlexNet)",
}
_PLACES = {title: place for place, title in enumerate(TRUTH.values())}


def shifts_of(run: Path) -> dict[float, dict[str, float]]:
    """Returns meters beside the path -> name of a number -> its mean over both sides; empty without such a record.

    Raises RecordError naming the file and the entry that is wrong.
    """
    record = NOVEL.find(run)
    sides: dict[float, dict[str, list[float]]] = {}
    for shift in () if record is None else record.shifts:
        found = sides.setdefault(abs(shift.offset), {})
        for name, value in (shift.distances | {TRUTH[name]: mean for name, mean in shift.truth.items()}).items():
            found.setdefault(name, []).append(value)
    return {meters: {name: statistics.fmean(some) for name, some in found.items()} for meters, found in sides.items()}


def mean_beside(arm: Arm, meters: float, name: str) -> float | None:
    """Returns the mean of an arm in which each scene counts once; None if no run has the number.

    Runs that were trained on all views count only if no run that holds views out has the number.
    """

    def value(record: RunRecord) -> float | None:
        return shifts_of(record.folder).get(meters, {}).get(name)

    return mean_over_scenes(arm.units_of_records(value) or arm.units_of_records(value, whole=True))


def beside_the_path(arms: Sequence[Arm]) -> Grid | None:
    """Returns PSNR and LPIPS to the truth and every recorded distance, by meters; None if no run recorded any."""
    measured = [shifts_of(record.folder) for arm in arms for record in arm.records]
    found = {(name, meters) for shifts in measured for meters, numbers in shifts.items() for name in numbers}
    columns = sorted(found, key=lambda column: (column[0] not in _PLACES, _PLACES.get(column[0], 0), column))
    if not columns:
        return None
    rows = []
    for arm in arms:
        runs = tuple(record.folder.name for record in arm.records)
        means = [mean_beside(arm, meters, name) for name, meters in columns]
        texts = [None if mean is None else _text(name, mean) for (name, _), mean in zip(columns, means, strict=True)]
        cells = [Cell() if text is None else Cell(text, runs=runs) for text in texts]
        rows.append((Cell(arm.title, runs=runs), *cells))
    header = (("", "arm"), *((name, f"{meters:g} m") for name, meters in columns))
    notes = (
        "mean of both sides; a distance of image sets is biased by their number, so that it compares arms of one sweep "
        "and says nothing by its level; only that of Inception's features is the published FID",
    )
    return Grid("beside", "Beside the recorded path", header, tuple(rows), notes)


def _text(name: str, mean: float) -> str:
    return f"{mean:.2f}" if name.endswith("dB") else f"{mean:.4g}"
