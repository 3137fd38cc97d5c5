"""The variants of a sweep: runs that may be averaged, their names, and the plain variant of each."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import pandas as pd

from sparsestreet.records.configuration import (
    IDENTITY_KEYS,
    Setting,
    chosen_options,
    config_hash,
    differing_options,
    given_keys,
    key_of,
    only,
    without,
)
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.collect import CLIP_KEYS, RunRecord, by_unit, clip_of, mean_over_scenes, run_frame
from sparsestreet.report.tables import BUSY, CLOCKS, busy_note

LOG_KEYS = ("data.log.*",)
SECTION_KEYS = ("split.*", "training_views.*", *LOG_KEYS)
"""Options that determine the images a run sees and is measured on. They put runs into different tables, not columns."""


_EARLIER_CONTROLS = {
    "random": "as many Gaussians, drawn at random",
    "opacity": "as many Gaussians, the most opaque",
    "capped": "the plain method, stopped at as many Gaussians",
}
"""Sparsifications of records from before configurations had ``sparsify.control`` -> what that would be."""

COUNT_KEYS = (
    "callback.pruning.rule.keep",
    "callback.pruning.rule.keep.*",
    "node.background.num_points",
    "node.background.max_gaussians",
)
"""Options of a control that follow from the run whose size it copies, seed by seed."""

_MAX_NAMED = 3
"""Largest number of options in the name of a column; the rest go into a note."""
_MAX_CHARACTERS = 40
"""Largest number of characters of an option in a name."""
_NO_CHOICE = ("data", "hydra", "sweep", "out", "folder", "method", "sparsify", "assignment")
"""Keys of a command that tell no variants of one label apart."""


@dataclass(frozen=True)
class Repeats:
    """Repeats: runs with one label and one configuration apart from seeds."""

    name: str
    """The label, followed by the options that distinguish it from the label's other variants."""
    label: str
    options: tuple[str, ...]
    """All distinguishing options; the name holds the first few."""
    runs: tuple[RunSummary, ...]


def repeats(runs: Sequence[RunSummary], everywhere: Sequence[RunSummary] = ()) -> list[Repeats]:
    """Groups the runs of one table into repeats, sorted by name.

    Args:
        runs: the runs of one table.
        everywhere: the runs of all tables that are read together, so that a variant has one name in all of them.
            Options under ``data.`` are named only if they differ within the table, since every data set has its own.
    """
    groups: dict[tuple[str, str], list[RunSummary]] = {}
    for run in runs:
        groups.setdefault((run.run.label, config_hash(_compared(run))), []).append(run)
    found = []
    for (label, identity), group in groups.items():
        anywhere, given_anywhere = _options(group[0], (*runs, *everywhere))
        here, given_here = _options(group[0], runs)
        options = (*_not_of_data(anywhere), *_of_data(here))
        named = (*_not_of_data(given_anywhere), *_of_data(given_here))
        name = f"{label} {in_few_words(named, identity)}".rstrip()
        found.append((Repeats(name, label, options, tuple(group)), identity))
    shared = Counter(variant.name for variant, _ in found)
    # Some differences have no words, such as an option that is null in one variant and absent in another.
    unique = [
        variant if shared[variant.name] == 1 else replace(variant, name=f"{variant.name} #{identity[:6]}")
        for variant, identity in found
    ]
    return sorted(unique, key=lambda variant: variant.name)


def control_of(run: RunSummary) -> str | None:
    """Return the kind of control that a run is, or None. A control only copies the size of another run."""
    control = run.run.config.get("sparsify.control", _EARLIER_CONTROLS.get(run.run.sparsify))
    return None if control is None else str(control)


def log_config(run: RunSummary) -> dict[str, Setting]:
    """Return the options that select the log and the images that a run saw, and whose masks measured it."""
    return {**only(without(run.run.config, IDENTITY_KEYS), LOG_KEYS), "masks": masks_of(run)}


def masks_of(run: RunSummary) -> str:
    """Return whose masks of people and vehicles a run has, such as "fine"; "unknown" of an older record."""
    human, vehicle = (run.run.masks.get(kind, "unknown") for kind in ("human", "vehicle"))
    return human if human == vehicle else f"people {human}, vehicles {vehicle}"


def masks_note(runs: Iterable[RunSummary]) -> list[str]:
    """Return a note on whose masks the numbers of people and vehicles are of; nothing where no record tells."""
    found = sorted({masks_of(run) for run in runs})
    several = ": never averaged" if len(found) > 1 else ""
    return [f"masks of people and vehicles: {' and '.join(found)}{several}"] if found not in ([], ["unknown"]) else []


def _compared(run: RunSummary) -> dict[str, Setting]:
    """Return the options by which runs of one table may differ; what grew with a log as where nothing grows."""
    follows = COUNT_KEYS if control_of(run) and run.run.config.get("count_of") else ()
    return without({**run.run.config, **run.run.follows}, (*IDENTITY_KEYS, *SECTION_KEYS, *follows))


def _options(run: RunSummary, others: Iterable[RunSummary]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the options by which a run differs from others of its label, and those of them that its name holds.

    If the options that the commands gave distinguish all configurations, choices of groups (``pruning=volume``) among
    them, the name holds those: the rest follows from them. Otherwise it holds all. ``others`` includes the run itself.
    """
    alike = [other for other in others if other.run.label == run.run.label]
    distinct = {config_hash(_compared(other)): _compared(other) for other in alike}
    chosen = _chosen(alike, list(distinct))
    commands = [other.run.command for other in alike]
    given = given_keys(commands)
    words = differing_options(list(distinct.values()), commands)
    short = [
        (*groups, *(word for word in options if key_of(word) in given))
        for groups, options in zip(chosen, words, strict=True)
    ]
    position = list(distinct).index(config_hash(_compared(run)))
    return words[position], (short if len(set(short)) == len(short) else words)[position]


def _chosen(runs: Sequence[RunSummary], identities: Sequence[str]) -> list[tuple[str, ...]]:
    """Return for each configuration the choices of groups that its commands gave, and that others did not give.

    A group without a dot in its key is no option of the configuration itself; one that differs between repeats says
    nothing of the configuration.
    """
    options = {key for run in runs for key in run.run.config}
    told: dict[str, list[dict[str, str]]] = {identity: [] for identity in identities}
    for run in runs:
        told[config_hash(_compared(run))].append(chosen_options(run.run.command))
    keys = dict.fromkeys(key for given in told.values() for one in given for key in one)
    keys = [key for key in keys if key not in options and key.partition("/")[0] not in _NO_CHOICE]
    keys = [key for key in keys if all(len({one.get(key) for one in given}) == 1 for given in told.values())]
    keys = [key for key in keys if len({given[0].get(key) for given in told.values()}) > 1]
    groups = [key.partition("@")[0] for key in keys]
    names = [group if groups.count(group) == 1 else key for key, group in zip(keys, groups, strict=True)]
    return [
        tuple(f"{name}={given[0][key]}" for key, name in zip(keys, names, strict=True) if key in given[0])
        for given in told.values()
    ]


def _of_data(options: Iterable[str]) -> list[str]:
    return [option for option in options if key_of(option).startswith("data.")]


def _not_of_data(options: Iterable[str]) -> list[str]:
    return [option for option in options if not key_of(option).startswith("data.")]


def in_few_words(options: Sequence[str], identity: str) -> str:
    """Return options for a name: the first few, cut to a length, with a hash if there are more.

    >>> in_few_words(["split.stride=5", "seed=1"], identity="0123456789ab")
    'split.stride=5, seed=1'
    """
    named = [_shortened(word) for word in options[:_MAX_NAMED]]
    if len(options) > _MAX_NAMED:
        named.append(f"and {len(options) - _MAX_NAMED} more #{identity[:6]}")
    return ", ".join(named)


def _shortened(word: str) -> str:
    """Return an option for a name. The ends of its key and of a class's path tell it apart, so their beginnings go.

    >>> _shortened("callback.pruning.rule._target_=mypaper.rules.VolumeRule")
    'rule=VolumeRule'
    """
    if len(word) <= _MAX_CHARACTERS:
        return word
    key, equals, value = word.partition("=")
    if key.endswith("._target_"):
        key, value = key.removesuffix("._target_"), value.rpartition(".")[2]
    short = f"{key.rpartition('.')[2]}{equals}{value}"
    return short if len(short) <= _MAX_CHARACTERS else f"{short[:_MAX_CHARACTERS]}..."


Unit = tuple[tuple[str, str], int]
"""A scene with the part of its log, and a seed."""

INCOMPLETE = "‡"
"""Marks a variant that lacks runs which others at its place have: its means compare with none of theirs."""


@dataclass(frozen=True)
class Variant:
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
    """Scenes and seeds, in words, that another variant at its place has and this one has not."""

    @property
    def control(self) -> str | None:
        """The kind of control, which is sized to match another variant; None for any other variant."""
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
        """The label of the plain variant that it is compared with."""
        return self.label.partition("+")[0]

    def runs(self, whole: bool = False) -> dict[Unit, list[RunRecord]]:
        """Return scene and seed -> its runs that were trained on all views (``whole``), or the others."""
        found: dict[Unit, list[RunRecord]] = {}
        for record in self.records:
            if (record.summary.run.split == "none") == whole:
                found.setdefault((clip_of(record.summary), record.summary.run.seed), []).append(record)
        return found

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The numbers of its runs; see ``run_frame``."""
        return run_frame(self.records)

    @property
    def run_names(self) -> tuple[str, ...]:
        """The names of the folders of its runs."""
        return tuple(record.folder.name for record in self.records)

    def units(self, column: str, whole: bool = False, clock: str = "") -> pd.Series:
        """Return scene, clip and seed -> the number of its run, or the mean of several runs.

        ``whole`` selects the runs that were trained on all views; otherwise the other runs count. With a ``clock``
        ("frames", "training") only runs count that were timed on a quiet machine.
        """
        rows = self.frame["whole"] == whole
        return by_unit(self.frame.loc[rows & self.frame[clock] if clock else rows], column)

    def mean(self, column: str, whole: bool = False) -> float | None:
        """Return the mean over scenes of the mean over each scene's seeds; None if no run has the number."""
        return mean_over_scenes(self.units(column, whole))

    def busy(self, clock: str) -> str:
        """Return the mark of times, of "frames" or of "training", if a machine was not quiet; else an empty text."""
        return "" if all(CLOCKS[clock](record.summary) for record in self.records) else BUSY


def busy_variants(found: Iterable[Variant]) -> list[str]:
    """Return a note that names the variants with times of a machine that was not quiet, or nothing."""
    return busy_note((variant.name, record.summary) for variant in found for record in variant.records)


def variants(records: Sequence[RunRecord]) -> list[Variant]:
    """Return the variants of a sweep, sorted by method; plain ones come before pruned ones, controls last."""
    folder_of = {id(record.summary): record for record in records}
    of_log, of_split = _logs_in_words(records), _splits_in_words(records)
    places = {
        key: (*_place(record.summary, records), of_log[key], of_split[key])
        for key, record in ((id(record.summary), record) for record in records)
    }
    columns = list(zip(*places.values(), strict=True))
    told = [index for index, column in enumerate(columns) if len(set(column)) > 1]
    found = []
    for variant in repeats([record.summary for record in records]):
        groups: dict[tuple[str, ...], list[RunRecord]] = {}
        for run in variant.runs:
            groups.setdefault(places[id(run)], []).append(folder_of[id(run)])
        for place, group in groups.items():
            words = ", ".join(place[index] for index in told)
            run = group[0].summary.run
            name = f"{variant.name} ({words})" if words else variant.name
            found.append(Variant(name, variant.label, run.method, run.sparsify, place, tuple(group)))
    found = [replace(variant, lacks=_lacks(variant, found)) for variant in found]
    return sorted(
        found,
        key=lambda variant: (
            variant.plain_label,
            variant.control is not None,
            variant.sparsify != "none",
            variant.name,
        ),
    )


def _units_of(variant: Variant) -> set[tuple[bool, Unit]]:
    return {(whole, unit) for whole in (False, True) for unit in variant.runs(whole)}


def _lacks(variant: Variant, among: Sequence[Variant]) -> tuple[str, ...]:
    own = _units_of(variant)
    others = {unit for other in among if other.place == variant.place for unit in _units_of(other)}
    words = ((scene, seed, ", all views" if whole else "") for whole, ((scene, _), seed) in sorted(others - own))
    return tuple(f"{scene} seed {seed}{kind}" for scene, seed, kind in words)


def incomplete(found: Sequence[Variant]) -> list[str]:
    """Return a note on the variants that lack runs which others have, or nothing."""
    lacking = [f"{variant.name} lacks {_few(variant.lacks)}" for variant in found if variant.lacks]
    if not lacking:
        return []
    return [
        f"{INCOMPLETE} fewer runs than other arms have, so that its means compare with none of theirs: read the "
        f"differences and the arrows, which are of scenes and seeds that both arms have. {'; '.join(lacking)}"
    ]


def _few(words: Sequence[str], most: int = 3) -> str:
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")


def plain_of(variant: Variant, among: Iterable[Variant]) -> Variant | None:
    """Return the plain variant of the same method at the same place; None if there is none or several."""
    plain = [
        other
        for other in among
        if other.sparsify == "none" and other.label == variant.plain_label and other.place == variant.place
    ]
    return plain[0] if len(plain) == 1 else None


def why_apart(found: Sequence[Variant]) -> list[str]:
    """Return notes on why some runs of this page are not averaged or compared."""
    if not found:
        return []
    said = []
    names = ("devices", "numbers of threads", "commits", "data of one name", "options of the log", "splits")
    for name, column in zip(names, zip(*(variant.place for variant in found), strict=True), strict=True):
        if len(set(column)) > 1:
            said.append(f"runs differ in {name} ({', '.join(sorted(set(column)))}): shown apart, never averaged")
    labels = [variant.label for variant in found]
    several = sorted({label for label in labels if labels.count(label) > 1})
    if several:
        said.append(f"{', '.join(several)}: runs of one label that differ are rows of their own, never averaged")
    dirty = sorted({variant.name for variant in found for record in variant.records if record.summary.run.source.dirty})
    if dirty:
        said.append(f"made by code with uncommitted changes: {', '.join(dirty)}")
    return said


def _place(run: RunSummary, records: Sequence[RunRecord]) -> tuple[str, ...]:
    made, measured = run.run, run.timing
    device = made.device if made.device == measured.device else f"{made.device}, measured on {measured.device}"
    threads = f"{made.threads} thread{'s' if made.threads != 1 else ''}"
    threads += f", measured with {measured.threads}" if made.threads != measured.threads else ""
    return device, threads, (made.source.commit or "no commit")[:9], _edition(run, records)


def _logs_in_words(records: Sequence[RunRecord]) -> dict[int, str]:
    """Return id of a run -> the options of its log in which runs differ, except which part of the log is read."""
    logs = {id(record.summary): without(log_config(record.summary), CLIP_KEYS) for record in records}
    distinct = {config_hash(log): log for log in logs.values()}
    words = dict(zip(distinct, differing_options(list(distinct.values())), strict=True))
    return {key: in_few_words(words[config_hash(log)], config_hash(log)) for key, log in logs.items()}


def _splits_in_words(records: Sequence[RunRecord]) -> dict[int, str]:
    """Return id of a run -> its held-out views in words; empty if all runs that hold views out agree."""
    splits = {id(record.summary): record.summary.run.split for record in records}
    return splits if len(set(splits.values()) - {"none"}) > 1 else dict.fromkeys(splits, "")


def _edition(run: RunSummary, records: Sequence[RunRecord]) -> str:
    """Return the start of the data's hash if runs of the scene have different data; else an empty text."""
    alike = {record.summary.run.data_hash for record in records if clip_of(record.summary) == clip_of(run)}
    return f"data {run.run.data_hash[:6]}" if len(alike) > 1 else ""
