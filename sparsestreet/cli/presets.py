"""``sparsestreet presets METHOD``: our presets beside DriveStudio's settings, key by key."""

import itertools
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from sparsestreet.cli.options import run_command
from sparsestreet.cli.upstream import Comparison, Row, Verdict, compare, pairs

USAGE = """\
sparsestreet presets [METHOD] [preset=drivestudio|drivestudio_legacy] [only=equal|differs|absent]

  sparsestreet presets                          which there are, and how many keys are equal, differ or are absent
  sparsestreet presets streetgs                 every key of DriveStudio's configurations of streetgs, beside ours
  sparsestreet presets omnire only=differs      those that differ alone, with the reasons
  sparsestreet presets omnire preset=drivestudio_legacy only=absent

Values here are those that preset=... method=... schedule=paper capacity=paper compose, in DriveStudio's terms: steps
instead of fractions of the run, rates without its factors. Our key stands beside them. A key that differs or is absent
has its reason below it. Where that changes results, every training says so at its start.
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
        print("\n".join(lines(compare(*pair), request.only)))


def overview() -> Iterator[str]:
    """A line for each preset and method, and what to ask next."""
    form = "{:<20}{:<10}{:<36}{:>5}{:>9}{:>8}{:>19}".format
    yield form("preset", "method", "DriveStudio's file", *_WORDS, "change results")
    for preset, method in pairs():
        found = compare(preset, method)
        counts = (found.count(verdict) for verdict in _WORDS)
        yield form(preset, method, f"configs/{found.column}.yaml", *counts, found.change_results)
    yield ""
    yield "sparsestreet presets METHOD shows every key; only=differs those that differ, with the reasons."


def lines(found: Comparison, only: Verdict | None = None) -> Iterator[str]:
    """The comparison as text of ``WIDTH`` columns: a section for each part of upstream's files."""
    counts = ", ".join(f"{found.count(verdict)} {word}" for verdict, word in _WORDS.items())
    yield f"preset={found.preset} method={found.method} beside configs/{found.column}.yaml of DriveStudio (e59bda4)"
    yield f"{counts}; {found.change_results} of these change results"
    shown = [row for row in found.rows if only in (None, row.verdict)]
    for section, rows in itertools.groupby(shown, _section):
        yield f"\n{section or 'general':<{_VALUES}}{'upstream':<13}here"
        for reason, alike in itertools.groupby(rows, _reason):
            yield from (_line(row) for row in alike)
            if reason:
                yield textwrap.fill(reason, WIDTH, initial_indent=_INDENT, subsequent_indent=_INDENT)
    if only is None:
        yield "\nwithout a key of upstream's, said by every training at its start:"
        yield from (textwrap.fill(note, WIDTH, initial_indent="  ", subsequent_indent="  ") for note in found.beyond)
    yield ""


_WORDS: dict[Verdict, str] = {"equal": "equal", "differs": "differ", "absent": "absent"}
_INDENT = 9 * " "
_VALUES = 52
"""Column at which values begin."""


def _section(row: Row) -> str:
    """Two names of a key, as far as more follow: ``model.Sky``, ``trainer`` of trainer.type."""
    return ".".join(row.key.split(".")[:-1][:2])


def _reason(row: Row) -> str:
    return "; ".join(row.reasons) + " (every training says so)" * row.said


def _line(row: Row) -> str:
    key = row.key.removeprefix(f"{_section(row)}.")
    line = f"{row.verdict:<{len(_INDENT)}}{key:<{_VALUES - len(_INDENT) - 1}} {_shown(row.upstream):<12} "
    line += f"{_shown(row.here) if row.ours else '-':<12} "
    ours = row.ours or ""
    if len(line) + len(ours) <= WIDTH:
        return (line + ours).rstrip()
    return f"{line.rstrip()}\n{' ' * min(_VALUES, WIDTH - len(ours))}{ours}"


def _shown(value: Any) -> str:
    """Numbers short, classes without their modules."""
    if isinstance(value, float):
        return f"{value:g}"
    return re.sub(r"[\w.]+\.(?=[A-Z]\w*$)", "", str(value))
