"""Scenes rendered with other settings than in training (``records/presets.json``): quality and speed."""

import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.records.presets import PRESETS, PresetRecord, RenderedAs
from sparsestreet.report.arms import Arm, Unit, mean_over_scenes
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.grid import Cell, Grid, number_cell
from sparsestreet.report.notes import BUSY
from sparsestreet.report.tradeoffs import difference_cell, interval_over_scenes

Number = Callable[[RenderedAs], float | None]
Records = dict[Unit, list[PresetRecord]]
Rendered = dict[Unit, list[RenderedAs]]
"""Scene and seed -> what its runs recorded."""

_REGIONS = ("full", "human", "vehicle")
_COSTS: tuple[tuple[str, str, str, Number], ...] = (
    ("", "dB to exact", "{:.1f}", lambda one: one.psnr_to_exact),
    ("", "ms/frame", "{:.2f}", lambda one: one.frame_ms),
)


def rendered_otherwise(arms: Sequence[Arm], protocol: Protocol) -> Grid | None:
    """Returns a row for each arm and preset that its runs have; None if no run has any.

    Raises RecordError for a malformed record.
    """
    recorded = [(arm, _records(arm)) for arm in arms]
    labels = Counter(arm.label for arm in arms)
    rows = [row for arm, records in recorded for row in _rows(arm, records, protocol, labels[arm.label] > 1)]
    if not rows:
        return None
    header = [("", "trained"), ("", "rendered"), ("", "n")]
    header += [(f"PSNR {region}", what) for region in _REGIONS for what in ("dB", "- as trained")]
    header += [(group, heading) for group, heading, _, _ in _COSTS]
    notes = [
        "one scene, the same held-out views; dB to exact: of the image against that of the same scene without cut-off "
        "and early stop; differences paired by scene and seed, with 95 % t intervals, bold where they exclude 0"
    ]
    if busy := [arm.name for arm, records in recorded if _busy(records)]:
        notes.append(f"{BUSY} times of a machine that was not quiet, compared with no other: {', '.join(busy)}")
    return Grid("presets", "Trained one way, rendered another", tuple(header), tuple(rows), tuple(notes))


def _records(arm: Arm) -> Records:
    """Returns the records of the runs that hold views out; if there are none, those of runs trained on all views."""
    return _found(arm.runs()) or _found(arm.runs(whole=True))


def _found(runs: dict[Unit, list[RunRecord]]) -> Records:
    found = {unit: [PRESETS.find(run.folder) for run in some] for unit, some in runs.items()}
    known = {unit: [record for record in some if record is not None] for unit, some in found.items()}
    return {unit: some for unit, some in known.items() if some}


def _rendered(records: Records, wanted: Callable[[RenderedAs], bool]) -> Rendered:
    """Returns scene and seed -> what its runs recorded of the settings that are wanted."""
    found = {unit: [one for record in some for one in record.rendered] for unit, some in records.items()}
    kept = {unit: [one for one in some if wanted(one)] for unit, some in found.items()}
    return {unit: some for unit, some in kept.items() if some}


def _rows(arm: Arm, records: Records, protocol: Protocol, several: bool) -> Iterator[tuple[Cell, ...]]:
    """``several``: whether several arms have this label. If so, the preset of training, if known, tells them apart."""
    runs = tuple(run.folder.name for run in arm.records)
    metrics = (protocol.psnr, protocol.human[0], protocol.vehicle[0])
    trained = _rendered(records, lambda one: one.trained)
    presets = {one.preset for some in trained.values() for one in some}
    title = f"{arm.label}, {presets.pop()}" if several and len(presets) == 1 else arm.title
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
