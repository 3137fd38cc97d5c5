"""Groups runs that are repeats of one another into variants, and gives different variants different names."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

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

LOG_KEYS = ("data.log.*",)
SECTION_KEYS = ("split.*", *LOG_KEYS)
"""Options that determine the images a run is measured on. They put runs into different tables, not columns."""

CLIP_KEYS = ("data.log.first_frame", "data.log.last_frame")
"""Options that select a part of a log. Runs that differ in them have different scenes, as runs of different logs do."""

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

_MOST_NAMED = 3
"""Largest number of options in the name of a column; the rest go into a note."""
_LONGEST = 40
"""Largest number of characters of an option in a name."""
_NO_CHOICE = ("data", "hydra", "sweep", "out", "folder", "method", "sparsify", "assignment")
"""Keys of a command that tell no arms of one label apart."""


@dataclass(frozen=True)
class Variant:
    """Repeats: runs with one label and one configuration apart from seeds."""

    name: str
    """The label, followed by the options that distinguish it from the label's other variants."""
    label: str
    options: tuple[str, ...]
    """All distinguishing options; the name holds the first few."""
    runs: tuple[RunSummary, ...]


def variants(runs: Sequence[RunSummary], everywhere: Sequence[RunSummary] = ()) -> list[Variant]:
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
        found.append((Variant(_name(label, named, identity), label, options, tuple(group)), identity))
    shared = Counter(variant.name for variant, _ in found)
    # Some differences have no words, such as an option that is null in one variant and absent in another.
    unique = [
        variant if shared[variant.name] == 1 else replace(variant, name=f"{variant.name} #{identity[:6]}")
        for variant, identity in found
    ]
    return sorted(unique, key=lambda variant: variant.name)


def control_of(run: RunSummary) -> str | None:
    """Returns the kind of control that a run is, or None. A control only copies the size of another run."""
    control = run.run.config.get("sparsify.control", _EARLIER_CONTROLS.get(run.run.sparsify))
    return None if control is None else str(control)


def log_config(run: RunSummary) -> dict[str, Setting]:
    """Returns the options that select the log and the images that a run saw."""
    return only(without(run.run.config, IDENTITY_KEYS), LOG_KEYS)


def _compared(run: RunSummary) -> dict[str, Setting]:
    """Returns the options by which runs of one table may differ."""
    follows = COUNT_KEYS if control_of(run) and run.run.config.get("count_of") else ()
    return without(run.run.config, (*IDENTITY_KEYS, *SECTION_KEYS, *follows))


def _options(run: RunSummary, others: Iterable[RunSummary]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Returns the options by which a run differs from others of its label, and those of them that its name holds.

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
    """Returns for each configuration the choices of groups that its commands gave, and that others did not give.

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


def _name(label: str, options: Sequence[str], identity: str) -> str:
    return f"{label} {in_few_words(options, identity)}".rstrip()


def in_few_words(options: Sequence[str], identity: str) -> str:
    """Returns options for a name: the first few, cut to a length, with a hash if there are more.

    >>> in_few_words(["split.stride=5", "seed=1"], identity="0123456789ab")
    'split.stride=5, seed=1'
    """
    named = [_shortened(word) for word in options[:_MOST_NAMED]]
    if len(options) > _MOST_NAMED:
        named.append(f"and {len(options) - _MOST_NAMED} more #{identity[:6]}")
    return ", ".join(named)


def _shortened(word: str) -> str:
    """Returns an option for a name. The ends of its key and of a class's path tell it apart, so their beginnings go.

    >>> _shortened("callback.pruning.rule._target_=mypaper.rules.VolumeRule")
    'rule=VolumeRule'
    """
    if len(word) <= _LONGEST:
        return word
    key, equals, value = word.partition("=")
    if key.endswith("._target_"):
        key, value = key.removesuffix("._target_"), value.rpartition(".")[2]
    short = f"{key.rpartition('.')[2]}{equals}{value}"
    return short if len(short) <= _LONGEST else f"{short[:_LONGEST]}..."
