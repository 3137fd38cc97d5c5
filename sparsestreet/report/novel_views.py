"""Quality off the recorded path (``records/novel.json``) and with other settings (``records/presets.json``)."""

import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from sparsestreet.metrics.protocols import Protocol
from sparsestreet.records.renders import NOVEL, PRESETS, PresetRecord, RenderedAs
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.tables import BUSY, Cell, Grid, number_cell
from sparsestreet.report.tradeoffs import difference_cell, interval_over_scenes
from sparsestreet.report.variants import Unit, Variant, mean_over_scenes

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


def mean_beside(variant: Variant, meters: float, name: str) -> float | None:
    """Returns the mean of a variant in which each scene counts once; None if no run has the number.

    Runs that were trained on all views count only if no run that holds views out has the number.
    """

    def value(record: RunRecord) -> float | None:
        return shifts_of(record.folder).get(meters, {}).get(name)

    return mean_over_scenes(variant.units_of_records(value) or variant.units_of_records(value, whole=True))


def beside_the_path(variants: Sequence[Variant]) -> Grid | None:
    """Returns PSNR and LPIPS to the truth and every recorded distance, by meters; None if no run recorded any."""
    measured = [shifts_of(record.folder) for variant in variants for record in variant.records]
    found = {(name, meters) for shifts in measured for meters, numbers in shifts.items() for name in numbers}
    columns = sorted(found, key=lambda column: (column[0] not in _PLACES, _PLACES.get(column[0], 0), column))
    if not columns:
        return None
    rows = []
    for variant in variants:
        runs = tuple(record.folder.name for record in variant.records)
        means = [mean_beside(variant, meters, name) for name, meters in columns]
        texts = [None if mean is None else _text(name, mean) for (name, _), mean in zip(columns, means, strict=True)]
        cells = [Cell() if text is None else Cell(text, runs=runs) for text in texts]
        rows.append((Cell(variant.title, runs=runs), *cells))
    header = (("", "arm"), *((name, f"{meters:g} m") for name, meters in columns))
    notes = (
        "mean of both sides; a distance of image sets is biased by their number, so that it compares arms of one sweep "
        "and says nothing by its level; only that of Inception's features is the published FID",
    )
    return Grid("beside", "Beside the recorded path", header, tuple(rows), notes)


def _text(name: str, mean: float) -> str:
    return f"{mean:.2f}" if name.endswith("dB") else f"{mean:.4g}"


Number = Callable[[RenderedAs], float | None]
Records = dict[Unit, list[PresetRecord]]
Rendered = dict[Unit, list[RenderedAs]]
"""Scene and seed -> what its runs recorded."""

_REGIONS = ("full", "human", "vehicle")
_COSTS: tuple[tuple[str, str, str, Number], ...] = (
    ("", "dB to exact", "{:.1f}", lambda one: one.psnr_to_exact),
    ("", "ms/frame", "{:.2f}", lambda one: one.frame_ms),
)


def rendered_otherwise(variants: Sequence[Variant], protocol: Protocol) -> Grid | None:
    """Returns a row for each variant and preset that its runs have; None if no run has any.

    Raises RecordError for a malformed record.
    """
    recorded = [(variant, _records(variant)) for variant in variants]
    labels = Counter(variant.label for variant in variants)
    rows = [
        row for variant, records in recorded for row in _rows(variant, records, protocol, labels[variant.label] > 1)
    ]
    if not rows:
        return None
    header = [("", "trained"), ("", "rendered"), ("", "n")]
    header += [(f"PSNR {region}", what) for region in _REGIONS for what in ("dB", "- as trained")]
    header += [(group, heading) for group, heading, _, _ in _COSTS]
    notes = [
        "one scene, the same held-out views; dB to exact: of the image against that of the same scene without cut-off "
        "and early stop; differences paired by scene and seed, with 95 % t intervals, bold where they exclude 0"
    ]
    if busy := [variant.name for variant, records in recorded if _busy(records)]:
        notes.append(f"{BUSY} times of a machine that was not quiet, compared with no other: {', '.join(busy)}")
    return Grid("presets", "Trained one way, rendered another", tuple(header), tuple(rows), tuple(notes))


def _records(variant: Variant) -> Records:
    """Returns the records of the runs that hold views out; if there are none, those of runs trained on all views."""
    return _found(variant.runs()) or _found(variant.runs(whole=True))


def _found(runs: dict[Unit, list[RunRecord]]) -> Records:
    found = {unit: [PRESETS.find(run.folder) for run in some] for unit, some in runs.items()}
    known = {unit: [record for record in some if record is not None] for unit, some in found.items()}
    return {unit: some for unit, some in known.items() if some}


def _rendered(records: Records, wanted: Callable[[RenderedAs], bool]) -> Rendered:
    """Returns scene and seed -> what its runs recorded of the settings that are wanted."""
    found = {unit: [one for record in some for one in record.rendered] for unit, some in records.items()}
    kept = {unit: [one for one in some if wanted(one)] for unit, some in found.items()}
    return {unit: some for unit, some in kept.items() if some}


def _rows(variant: Variant, records: Records, protocol: Protocol, several: bool) -> Iterator[tuple[Cell, ...]]:
    """Yield a row for each preset; the preset of training tells ``several`` variants of a label apart."""
    runs = tuple(run.folder.name for run in variant.records)
    metrics = (protocol.psnr, protocol.human[0], protocol.vehicle[0])
    trained = _rendered(records, lambda one: one.trained)
    presets = {one.preset for some in trained.values() for one in some}
    title = f"{variant.label}, {presets.pop()}" if several and len(presets) == 1 else variant.title
    every = [one for some in _rendered(records, lambda one: True).values() for one in some]
    for preset in dict.fromkeys(one.preset for one in every):
        found = _rendered(records, lambda one, preset=preset: one.preset == preset)
        name = f"{preset}, as trained" if all(one.trained for some in found.values() for one in some) else preset
        cells = [Cell(title, runs=runs), Cell(name, runs=runs), Cell(str(len(found)), runs=runs)]
        for metric in metrics:
            cells += _quality(found, trained, metric, runs)
        for _, heading, form, number in _COSTS:
            mark = _busy(records) if heading == "ms/frame" else ""
            cells.append(number_cell(mean_over_scenes(_values(found, number)), form, runs, mark))
        yield tuple(cells)


def _busy(records: Records) -> str:
    """Returns the mark of milliseconds if a machine was not quiet; else an empty text."""
    return "" if all(record.noise.quiet for some in records.values() for record in some) else BUSY


def _quality(found: Rendered, trained: Rendered, metric: str, runs: tuple[str, ...]) -> list[Cell]:
    """Returns the mean over scenes, and the paired difference to the settings of training."""
    ours, theirs = (_values(one, lambda rendered: rendered.quality.get(metric)) for one in (found, trained))
    differences = {unit: ours[unit] - theirs[unit] for unit in ours.keys() & theirs.keys()}
    interval = None if found == trained else interval_over_scenes(differences)
    return [_mean(ours, "{:.2f}", runs), difference_cell(interval, "{:+.2f}", len(found), runs)]


def _values(found: Rendered, number: Number) -> dict[Unit, float]:
    """Returns scene and seed -> the number of its run, or the mean of several runs."""
    values = {unit: [value for one in some if (value := number(one)) is not None] for unit, some in found.items()}
    return {unit: statistics.fmean(some) for unit, some in values.items() if some}


def _mean(values: dict[Unit, float], form: str, runs: tuple[str, ...]) -> Cell:
    return number_cell(mean_over_scenes(values), form, runs)
