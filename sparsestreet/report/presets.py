"""Scenes rendered with other settings than in training (``records/presets.json``): quality and speed."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence

from sparsestreet.metrics.protocols import Protocol
from sparsestreet.records.presets import PRESETS, PresetRecord, RenderedAs
from sparsestreet.report.arms import Arm, Unit, mean_over_scenes, unit_of
from sparsestreet.report.grid import ABSENT, Cell, Grid
from sparsestreet.report.tradeoffs import difference_cell, interval_over_scenes

Number = Callable[[RenderedAs], float | None]

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
    if not all(record.noise.quiet for _, records in recorded for record in records.values()):
        notes.append("milliseconds of a machine that was not quiet")
    return Grid("presets", "Trained one way, rendered another", tuple(header), tuple(rows), tuple(notes))


def _records(arm: Arm) -> dict[Unit, PresetRecord]:
    found = {unit_of(run.summary): PRESETS.find(run.folder) for run in arm.records}
    return {unit: record for unit, record in found.items() if record is not None}


def _rows(arm: Arm, records: dict[Unit, PresetRecord], protocol: Protocol, several: bool) -> Iterator[tuple[Cell, ...]]:
    """``several``: whether several arms have this label. If so, the preset of training, if known, tells them apart."""
    runs = tuple(run.folder.name for run in arm.records)
    metrics = (protocol.psnr, protocol.human[0], protocol.vehicle[0])
    trained = {unit: one for unit, record in records.items() for one in record.rendered if one.trained}
    presets = {one.preset for one in trained.values()}
    title = f"{arm.label}, {presets.pop()}" if several and len(presets) == 1 else arm.title
    for preset in dict.fromkeys(one.preset for record in records.values() for one in record.rendered):
        found = {unit: one for unit, record in records.items() for one in record.rendered if one.preset == preset}
        name = f"{preset}, as trained" if all(one.trained for one in found.values()) else preset
        cells = [Cell(title, runs=runs), Cell(name, runs=runs), Cell(str(len(found)), runs=runs)]
        for metric in metrics:
            cells += _quality(found, trained, metric, runs)
        for _, _, form, number in _COSTS:
            cells.append(_mean(_values(found, number), form, runs))
        yield tuple(cells)


def _quality(
    found: dict[Unit, RenderedAs], trained: dict[Unit, RenderedAs], metric: str, runs: tuple[str, ...]
) -> list[Cell]:
    """Returns the mean over scenes, and the paired difference to the settings of training."""
    ours, theirs = (_values(one, lambda rendered: rendered.quality.get(metric)) for one in (found, trained))
    differences = {unit: ours[unit] - theirs[unit] for unit in ours.keys() & theirs.keys()}
    interval = None if found == trained else interval_over_scenes(differences)
    return [_mean(ours, "{:.2f}", runs), difference_cell(interval, "{:+.2f}", len(found), runs)]


def _values(found: dict[Unit, RenderedAs], number: Number) -> dict[Unit, float]:
    values = {unit: number(one) for unit, one in found.items()}
    return {unit: value for unit, value in values.items() if value is not None}


def _mean(values: dict[Unit, float], form: str, runs: tuple[str, ...]) -> Cell:
    mean = mean_over_scenes(values)
    return Cell(ABSENT if mean is None else form.format(mean), runs=runs)
