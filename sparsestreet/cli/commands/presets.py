"""``sparsestreet presets METHOD``: our presets beside DriveStudio's settings, key by key, as a table holds them."""

import csv
import itertools
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from sparsestreet.cli.commands.options import run_command

TABLE = Path(__file__).with_name("drivestudio_comparison.tsv")
Verdict = Literal["equal", "differs", "absent"]
SAID = "(every training says so)"
"""End of a reason that stands in ``preset.absent``."""


@dataclass(frozen=True)
class Row:
    """A setting of upstream's beside ours, or a note (verdict ``said``) on what no key says. ``-``: there is none."""

    preset: str
    method: str
    file: str
    """Upstream's."""
    verdict: str
    key: str
    upstream: str
    here: str
    """Our value, in upstream's terms."""
    ours: str
    """Our key; with alternatives ``a|b`` that the configuration has."""
    value: str
    """Our value, as it is composed."""
    reason: str
    """Of a row that differs or is absent."""


@cache
def table() -> tuple[Row, ...]:
    """Return the rows of all presets and methods."""
    lines = (line for line in TABLE.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return tuple(Row(**cells) for cells in csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE))


def pairs() -> list[tuple[str, str]]:
    """Return preset and method of all that are compared."""
    return list(dict.fromkeys((row.preset, row.method) for row in table()))


def rows_of(preset: str, method: str) -> list[Row]:
    """Return the rows of a preset with a method."""
    return [row for row in table() if (row.preset, row.method) == (preset, method)]


USAGE = """\
sparsestreet presets [METHOD] [preset=drivestudio|drivestudio_legacy] [only=equal|differs|absent]

  sparsestreet presets                          which there are, and how many keys are equal, differ or are absent
  sparsestreet presets streetgs                 every key of DriveStudio's configurations of streetgs, beside ours
  sparsestreet presets omnire only=differs      those that differ alone, with the reasons
  sparsestreet presets omnire preset=drivestudio_legacy only=absent

The table is written down (drivestudio_comparison.tsv). Values are those that schedule=paper capacity=paper compose,
in DriveStudio's terms: steps instead of fractions of the run, rates without its factors. A key that differs or is
absent has its reason below it. Where that changes results, every training says so at its start.
"""
WIDTH = 120


@dataclass(frozen=True)
class PresetsRequest:
    """The command's options. Raises ValueError for a method or a preset of which there is none."""

    method: str
    preset: Literal["drivestudio", "drivestudio_legacy"] | None = None
    only: Verdict | None = None

    def __post_init__(self) -> None:
        if not self.pairs():
            found = dict.fromkeys(method for preset, method in pairs() if self.preset in (None, preset))
            of = f"preset={self.preset}" if self.preset else "DriveStudio"
            raise ValueError(f"no method={self.method} of {of}: choose one of {', '.join(found)}")

    def pairs(self) -> list[tuple[str, str]]:
        return [pair for pair in pairs() if pair[1] == self.method and self.preset in (None, pair[0])]


def presets(arguments: list[str]) -> int:
    """Print which there are, or the comparison of those that are asked for; statuses as in ``run_command``."""
    if not arguments:
        print("\n".join(overview()))
        return 0
    return run_command("presets", USAGE, arguments, PresetsRequest, _presets, positional=("method",))


def _presets(request: PresetsRequest) -> None:
    for pair in request.pairs():
        print("\n".join(lines(rows_of(*pair), request.only)))


def overview() -> Iterator[str]:
    """Yield a line for each preset and method, and what to ask next."""
    form = "{:<20}{:<10}{:<36}{:>5}{:>9}{:>8}{:>19}".format
    yield form("preset", "method", "DriveStudio's file", *_WORDS, "change results")
    for preset, method in pairs():
        rows = rows_of(preset, method)
        counts = (_count(rows, verdict) for verdict in _WORDS)
        yield form(preset, method, f"configs/{rows[0].file}.yaml", *counts, _changes(rows))
    yield ""
    yield "sparsestreet presets METHOD shows every key; only=differs those that differ, with the reasons."


def lines(rows: list[Row], only: Verdict | None = None) -> Iterator[str]:
    """Yield the comparison as text of ``WIDTH`` columns: a section for each part of upstream's files."""
    first = rows[0]
    yield f"preset={first.preset} method={first.method} beside configs/{first.file}.yaml of DriveStudio (e59bda4)"
    counts = ", ".join(f"{_count(rows, verdict)} {word}" for verdict, word in _WORDS.items())
    yield f"{counts}; {_changes(rows)} of these change results"
    shown = [row for row in rows if row.verdict != "said" and only in (None, row.verdict)]
    for section, part in itertools.groupby(shown, _section):
        yield f"\n{section or 'general':<{_VALUES}}{'upstream':<13}here"
        for reason, alike in itertools.groupby(part, lambda row: row.reason):
            yield from (_line(row) for row in alike)
            if reason:
                yield textwrap.fill(reason, WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT)
    if only is None:
        yield "\nwithout a key of upstream's, said by every training at its start:"
        notes = (row.reason for row in rows if row.verdict == "said")
        yield from (textwrap.fill(note, WIDTH, initial_indent="  ", subsequent_indent="  ") for note in notes)
    yield ""


_WORDS: dict[Verdict, str] = {"equal": "equal", "differs": "differ", "absent": "absent"}
_INDENT = 9 * " "
_VALUES = 52
"""Column at which values begin."""


def _count(rows: list[Row], verdict: Verdict) -> int:
    return sum(row.verdict == verdict for row in rows)


def _changes(rows: list[Row]) -> int:
    return sum(row.reason.endswith(SAID) for row in rows)


def _section(row: Row) -> str:
    """Return two names of a key, as far as more follow: ``model.Sky``, ``trainer`` of trainer.type."""
    return ".".join(row.key.split(".")[:-1][:2])


def _line(row: Row) -> str:
    key = row.key.removeprefix(f"{_section(row)}.")
    # Classes without their modules.
    upstream = re.sub(r"[\w.]+\.(?=[A-Z]\w*$)", "", row.upstream)
    line = f"{row.verdict:<{len(_INDENT)}}{key:<{_VALUES - len(_INDENT) - 1}} {upstream:<12} {row.here:<12} "
    ours = "" if row.ours == "-" else row.ours
    if len(line) + len(ours) <= WIDTH:
        return (line + ours).rstrip()
    return f"{line.rstrip()}\n{' ' * min(_VALUES, WIDTH - len(ours))}{ours}"
