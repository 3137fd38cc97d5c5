"""Which runs are repeats of one another, and how those that are not get names of their own."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sparsestreet.evaluation.configuration import (
    IDENTITY_KEYS,
    Setting,
    config_hash,
    differing_options,
    only,
    without,
)
from sparsestreet.evaluation.records import RunSummary

LOG_KEYS = ("data.log.*",)
SECTION_KEYS = ("split.*", *LOG_KEYS)
"""Options that settle which images a run is measured on: they set runs into different tables, not columns."""

CLIP_KEYS = ("data.log.first_frame", "data.log.last_frame")
"""Options that say which part of a log is read: where they differ, scenes differ, as where logs do."""

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
        here, anywhere = _of_label(runs, label), _of_label((*runs, *everywhere), label)
        options = (*_options(group[0], anywhere, _method), *_options(group[0], here, _data))
        found.append((Variant(_name(label, options, identity), label, options, tuple(group)), identity))
    shared = Counter(variant.name for variant, _ in found)
    # Differences that words cannot tell, such as an option that is null in one and absent in the other.
    named = [
        variant if shared[variant.name] == 1 else replace(variant, name=f"{variant.name} #{identity[:6]}")
        for variant, identity in found
    ]
    return sorted(named, key=lambda variant: variant.name)


def log_config(run: RunSummary) -> dict[str, Setting]:
    """The options that say which images of which log a run saw."""
    return only(without(run.run.config, IDENTITY_KEYS), LOG_KEYS)


def _compared(run: RunSummary) -> dict[str, Setting]:
    """The options by which runs of one table may differ."""
    return without(run.run.config, (*IDENTITY_KEYS, *SECTION_KEYS))


def _method(run: RunSummary) -> dict[str, Setting]:
    return without(_compared(run), ("data.*",))


def _data(run: RunSummary) -> dict[str, Setting]:
    return only(_compared(run), ("data.*",))


def _of_label(runs: Sequence[RunSummary], label: str) -> list[RunSummary]:
    return [run for run in runs if run.run.label == label]


def _options(
    run: RunSummary, others: Sequence[RunSummary], part: Callable[[RunSummary], dict[str, Setting]]
) -> tuple[str, ...]:
    """The options by which a part of a run's configuration differs from that of others, itself among them."""
    distinct = {config_hash(part(other)): part(other) for other in others}
    words = differing_options(list(distinct.values()), [other.run.command for other in others])
    return dict(zip(distinct, words, strict=True))[config_hash(part(run))]


def _name(label: str, options: tuple[str, ...], identity: str) -> str:
    named = [word if len(word) <= _LONGEST else f"{word[:_LONGEST]}..." for word in options[:_MOST_NAMED]]
    if len(options) > _MOST_NAMED:
        named.append(f"and {len(options) - _MOST_NAMED} more #{identity[:6]}")
    return f"{label} {', '.join(named)}" if named else label
