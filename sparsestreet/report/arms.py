"""The arms of a sweep: groups of runs that may be averaged, and the plain arm that each is compared with."""

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from sparsestreet.records.configuration import config_hash, differing_options, only, without
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.collect import RunRecord
from sparsestreet.report.notes import BUSY, CLOCKS, busy_note
from sparsestreet.report.variants import CLIP_KEYS, control_of, in_few_words, log_config, variants

Value = Callable[[RunSummary], float | None]
RecordValue = Callable[[RunRecord], float | None]
Unit = tuple[tuple[str, str], int]
"""A scene with the part of its log, and a seed."""

INCOMPLETE = "‡"
"""Marks an arm that lacks runs which others at its place have: its means compare with none of theirs."""


@dataclass(frozen=True)
class Arm:
    """Repeats on one or more scenes, with one configuration, data, device, number of threads and commit."""

    name: str
    label: str
    method: str
    sparsify: str
    place: tuple[str, ...]
    """Device, threads and commit. Also the data of a scene, options of the log and split if the sweep has several."""
    records: tuple[RunRecord, ...]
    """Runs of both kinds: trained without the held-out views, and trained on all views."""
    lacks: tuple[str, ...] = ()
    """Scenes and seeds, in words, that another arm at its place has and this one has not."""

    @property
    def control(self) -> str | None:
        """The kind of control, which is sized to match another arm; None for any other arm."""
        return control_of(self.records[0].summary)

    @property
    def title(self) -> str:
        """The name in a table, with the number of runs if others have more."""
        name = f"control: {self.name}" if self.control else self.name
        if not self.lacks:
            return name
        own = len(_units_of(self))
        return f"{name} ({own} of {own + len(self.lacks)} runs {INCOMPLETE})"

    @property
    def plain_label(self) -> str:
        """The label of the plain arm that it is compared with."""
        return self.label.partition("+")[0]

    def runs(self, whole: bool = False) -> dict[Unit, list[RunRecord]]:
        """Returns scene and seed -> its runs that were trained on all views (``whole``), or the others."""
        found: dict[Unit, list[RunRecord]] = {}
        for record in self.records:
            if (record.summary.run.split == "none") == whole:
                found.setdefault(unit_of(record.summary), []).append(record)
        return found

    def units(self, value: Value, whole: bool = False) -> dict[Unit, float]:
        """Returns scene and seed -> the value of its run, or the mean of several runs.

        ``whole`` selects the runs that were trained on all views; otherwise the other runs count.
        """
        return self.units_of_records(lambda record: value(record.summary), whole)

    def units_of_records(self, value: RecordValue, whole: bool = False) -> dict[Unit, float]:
        """Does the same as ``units`` for a value that may be in another file of a run's folder."""
        found = {unit: [value(record) for record in records] for unit, records in self.runs(whole).items()}
        known = {unit: [number for number in numbers if number is not None] for unit, numbers in found.items()}
        return {unit: statistics.fmean(numbers) for unit, numbers in known.items() if numbers}

    def mean(self, value: Value, whole: bool = False) -> float | None:
        """Returns the mean over scenes of the mean over each scene's seeds; None if no run has the value."""
        return mean_over_scenes(self.units(value, whole))

    def busy(self, clock: str) -> str:
        """Returns the mark of times, of "frames" or of "training", if a machine was not quiet; else an empty text."""
        return "" if all(CLOCKS[clock](record.summary) for record in self.records) else BUSY


def busy_arms(found: Iterable[Arm]) -> list[str]:
    """Returns a note that names the arms with times of a machine that was not quiet, or nothing."""
    return busy_note((arm.name, record.summary) for arm in found for record in arm.records)


def unit_of(run: RunSummary) -> Unit:
    """Returns the key by which runs of two arms are paired."""
    return (run.run.scene, config_hash(only(run.run.config, CLIP_KEYS))), run.run.seed


def mean_over_scenes(units: dict[Unit, float]) -> float | None:
    """Returns the mean in which each scene counts once; None without values.

    >>> mean_over_scenes({(("street", ""), 0): 1.0, (("street", ""), 1): 3.0, (("park", ""), 0): 6.0})
    4.0
    """
    values = list(by_scene(units).values())
    return statistics.fmean(values) if values else None


def by_scene(units: dict[Unit, float]) -> dict[tuple[str, str], float]:
    """Returns scene -> mean over its seeds.

    >>> by_scene({(("street", ""), 0): 1.0, (("street", ""), 1): 3.0})
    {('street', ''): 2.0}
    """
    scenes: dict[tuple[str, str], list[float]] = {}
    for (scene, _), value in units.items():
        scenes.setdefault(scene, []).append(value)
    return {scene: statistics.fmean(values) for scene, values in scenes.items()}


def arms(records: Sequence[RunRecord]) -> list[Arm]:
    """Groups the runs of a sweep into arms, sorted by method; plain arms come before pruned ones, controls last."""
    folder_of = {id(record.summary): record for record in records}
    of_log, of_split = _logs_in_words(records), _splits_in_words(records)
    places = {
        key: (*_place(record.summary, records), of_log[key], of_split[key])
        for key, record in ((id(record.summary), record) for record in records)
    }
    columns = list(zip(*places.values(), strict=True))
    told = [index for index, column in enumerate(columns) if len(set(column)) > 1]
    found = []
    for variant in variants([record.summary for record in records]):
        groups: dict[tuple[str, ...], list[RunRecord]] = {}
        for run in variant.runs:
            groups.setdefault(places[id(run)], []).append(folder_of[id(run)])
        for place, group in groups.items():
            words = ", ".join(place[index] for index in told)
            run = group[0].summary.run
            name = f"{variant.name} ({words})" if words else variant.name
            found.append(Arm(name, variant.label, run.method, run.sparsify, place, tuple(group)))
    found = [replace(arm, lacks=_lacks(arm, found)) for arm in found]
    return sorted(found, key=lambda arm: (arm.plain_label, arm.control is not None, arm.sparsify != "none", arm.name))


def _units_of(arm: Arm) -> set[tuple[bool, Unit]]:
    return {(whole, unit) for whole in (False, True) for unit in arm.runs(whole)}


def _lacks(arm: Arm, among: Sequence[Arm]) -> tuple[str, ...]:
    own = _units_of(arm)
    others = {unit for other in among if other.place == arm.place for unit in _units_of(other)}
    words = ((scene, seed, ", all views" if whole else "") for whole, ((scene, _), seed) in sorted(others - own))
    return tuple(f"{scene} seed {seed}{kind}" for scene, seed, kind in words)


def incomplete(found: Sequence[Arm]) -> list[str]:
    """Returns a note on the arms that lack runs which others have, or nothing."""
    lacking = [f"{arm.name} lacks {_few(arm.lacks)}" for arm in found if arm.lacks]
    if not lacking:
        return []
    return [
        f"{INCOMPLETE} fewer runs than other arms have, so that its means compare with none of theirs: read the "
        f"differences and the arrows, which are of scenes and seeds that both arms have. {'; '.join(lacking)}"
    ]


def _few(words: Sequence[str], most: int = 3) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def plain_of(arm: Arm, among: Iterable[Arm]) -> Arm | None:
    """Returns the plain arm of the same method at the same place; None if there is none or several."""
    plain = [
        other
        for other in among
        if other.sparsify == "none" and other.label == arm.plain_label and other.place == arm.place
    ]
    return plain[0] if len(plain) == 1 else None


def why_apart(found: Sequence[Arm]) -> list[str]:
    """Returns notes on why some runs of this page are not averaged or compared."""
    if not found:
        return []
    said = []
    names = ("devices", "numbers of threads", "commits", "data of one name", "options of the log", "splits")
    for name, column in zip(names, zip(*(arm.place for arm in found), strict=True), strict=True):
        if len(set(column)) > 1:
            said.append(f"runs differ in {name} ({', '.join(sorted(set(column)))}): shown apart, never averaged")
    labels = [arm.label for arm in found]
    several = sorted({label for label in labels if labels.count(label) > 1})
    if several:
        said.append(f"{', '.join(several)}: runs of one label that differ are rows of their own, never averaged")
    dirty = sorted({arm.name for arm in found for record in arm.records if record.summary.run.source.dirty})
    if dirty:
        said.append(f"made by code with uncommitted changes: {', '.join(dirty)}")
    return said


def _place(run: RunSummary, records: Sequence[RunRecord]) -> tuple[str, ...]:
    made, measured = run.run, run.evaluated
    device = made.device if made.device == measured.device else f"{made.device}, measured on {measured.device}"
    threads = f"{made.threads} thread{'s' if made.threads != 1 else ''}"
    threads += f", measured with {measured.threads}" if made.threads != measured.threads else ""
    return device, threads, (made.source.commit or "no commit")[:9], _edition(run, records)


def _logs_in_words(records: Sequence[RunRecord]) -> dict[int, str]:
    """Returns id of a run -> the options of its log in which runs differ, except which part of the log is read."""
    logs = {id(record.summary): without(log_config(record.summary), CLIP_KEYS) for record in records}
    distinct = {config_hash(log): log for log in logs.values()}
    words = dict(zip(distinct, differing_options(list(distinct.values())), strict=True))
    return {key: in_few_words(words[config_hash(log)], config_hash(log)) for key, log in logs.items()}


def _splits_in_words(records: Sequence[RunRecord]) -> dict[int, str]:
    """Returns id of a run -> its held-out views in words; empty if all runs that hold views out agree."""
    splits = {id(record.summary): record.summary.run.split for record in records}
    return splits if len(set(splits.values()) - {"none"}) > 1 else dict.fromkeys(splits, "")


def _edition(run: RunSummary, records: Sequence[RunRecord]) -> str:
    """Returns the start of the data's hash if runs of the scene have different data; else an empty text."""
    alike = {record.summary.run.data_hash for record in records if unit_of(record.summary)[0] == unit_of(run)[0]}
    return f"data {run.run.data_hash[:6]}" if len(alike) > 1 else ""
