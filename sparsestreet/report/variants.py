"""Which runs are repeats of one another, and how those that are not get names of their own."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from sparsestreet.records.configuration import (
    IDENTITY_KEYS,
    Setting,
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
"""Options that settle which images a run is measured on: they set runs into different tables, not columns."""

CLIP_KEYS = ("data.log.first_frame", "data.log.last_frame")
"""Options that say which part of a log is read: where they differ, scenes differ, as where logs do."""

_EARLIER_CONTROLS = {
    "random": "as many Gaussians, drawn at random",
    "opacity": "as many Gaussians, the most opaque",
    "capped": "the plain method, stopped at as many Gaussians",
}
"""Sparsifications of records made before a configuration said ``sparsify.control`` -> what that would be."""

COUNT_KEYS = (
    "callback.pruning.rule.keep",
    "callback.pruning.rule.keep.*",
    "node.background.num_points",
    "node.background.max_gaussians",
)
"""Options of a control that follow from the run whose size it has, seed by seed."""

_MOST_NAMED = 3
"""Options in the name of a column; what is beyond goes into a note."""
_LONGEST = 40
"""Characters of an option in a name."""


@dataclass(frozen=True)
class Variant:
    """Repeats: runs with one label and one configuration, seeds aside."""

    name: str
    """The label, followed by the options that tell it from the label's other variants."""
    label: str
    options: tuple[str, ...]
    """All options that do so; the name holds the first few."""
    runs: tuple[RunSummary, ...]


def variants(runs: Sequence[RunSummary], everywhere: Sequence[RunSummary] = ()) -> list[Variant]:
    """The runs of one table in groups of repeats, sorted by name.

    Args:
        runs: of one table.
        everywhere: of all tables that are read together, so that a variant has one name in all of them. Options under
            ``data.`` are named only where they differ within the table, since every data set has its own.
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
    # Differences that words cannot tell, such as an option that is null in one and absent in the other.
    unique = [
        variant if shared[variant.name] == 1 else replace(variant, name=f"{variant.name} #{identity[:6]}")
        for variant, identity in found
    ]
    return sorted(unique, key=lambda variant: variant.name)


def control_of(run: RunSummary) -> str | None:
    """What kind of control a run is, which is no way to get small but has the size of another run; None: it is none."""
    return run.run.config.get("sparsify.control", _EARLIER_CONTROLS.get(run.run.sparsify))


def log_config(run: RunSummary) -> dict[str, Setting]:
    """The options that say which images of which log a run saw."""
    return only(without(run.run.config, IDENTITY_KEYS), LOG_KEYS)


def _compared(run: RunSummary) -> dict[str, Setting]:
    """The options by which runs of one table may differ."""
    follows = COUNT_KEYS if control_of(run) and run.run.config.get("count_of") else ()
    return without(run.run.config, (*IDENTITY_KEYS, *SECTION_KEYS, *follows))


def _options(run: RunSummary, others: Iterable[RunSummary]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The options by which a run differs from others of its label, itself among them; and those that are named.

    The latter are the ones that the commands gave, where these tell all configurations apart: the rest follows from
    them. Else they are all.
    """
    alike = [other for other in others if other.run.label == run.run.label]
    distinct = {config_hash(_compared(other)): _compared(other) for other in alike}
    commands = [other.run.command for other in alike]
    given = given_keys(commands)
    words = differing_options(list(distinct.values()), commands)
    short = [tuple(word for word in options if key_of(word) in given) for options in words]
    position = list(distinct).index(config_hash(_compared(run)))
    return words[position], (short if len(set(short)) == len(short) else words)[position]


def _of_data(options: Iterable[str]) -> list[str]:
    return [option for option in options if key_of(option).startswith("data.")]


def _not_of_data(options: Iterable[str]) -> list[str]:
    return [option for option in options if not key_of(option).startswith("data.")]


def _name(label: str, options: Sequence[str], identity: str) -> str:
    return f"{label} {in_few_words(options, identity)}".rstrip()


def in_few_words(options: Sequence[str], identity: str) -> str:
    """Options for a name: the first few, cut to a length; where there are more, a hash tells them apart."""
    named = [word if len(word) <= _LONGEST else f"{word[:_LONGEST]}..." for word in options[:_MOST_NAMED]]
    if len(options) > _MOST_NAMED:
        named.append(f"and {len(options) - _MOST_NAMED} more #{identity[:6]}")
    return ", ".join(named)
