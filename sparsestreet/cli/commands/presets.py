"""Our presets beside DriveStudio's settings: each of its keys is equal here, differs or is absent, with the reason."""

import ast
import csv
import itertools
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

from omegaconf import DictConfig, OmegaConf

from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.config.compose import composed, resolved
from sparsestreet.records.configuration import flat_config

SETTINGS = Path(__file__).with_name("drivestudio_settings.tsv")
KEYS = Path(__file__).with_name("drivestudio_keys.yaml")
Verdict = Literal["equal", "differs", "absent"]
NOTHING = "-"
"""What a file of settings has in place of a key that it has not."""


@dataclass(frozen=True)
class Row:
    """A setting of upstream's beside ours."""

    key: str
    upstream: Any
    ours: str | None
    """Our key; with alternatives ``a|b`` that the configuration has. None: there is none."""
    here: Any
    """Our value, in upstream's terms; a list of values where our keys do not agree."""
    verdict: Verdict
    reasons: tuple[str, ...]
    """One of a row that differs or is absent, none of an equal one: ``problems`` names the others."""
    said: bool = False
    """Whether the reason stands in ``preset.absent``, so that a training says it at its start."""


@dataclass(frozen=True)
class Comparison:
    """A preset of ours with a method, beside a file of upstream's."""

    preset: str
    method: str
    column: str
    rows: tuple[Row, ...]
    beyond: tuple[str, ...]
    """What else a training says at its start: where upstream's code differs, and no key says so."""

    @property
    def change_results(self) -> int:
        """How many rows change results."""
        return sum(row.said for row in self.rows)

    def count(self, verdict: Verdict) -> int:
        return sum(row.verdict == verdict for row in self.rows)


def pairs() -> list[tuple[str, str]]:
    """Preset and method of all that can be compared."""
    return [cast(tuple[str, str], tuple(name.split("/"))) for name in _keys()["columns"]]


@cache
def compare(preset: str, method: str) -> Comparison:
    """The preset as ``schedule=paper capacity=paper`` compose it, beside upstream's settings.

    Raises ValueError for a pair that is not of ``pairs``.
    """
    if (preset, method) not in pairs():
        methods = [one for name, one in pairs() if name == preset]
        raise ValueError(f"preset={preset} has no method={method}: choose one of {', '.join(methods)}")
    cfg = composed((f"preset={preset}", f"method={method}", "schedule=paper", "capacity=paper"))
    column = _keys()["columns"][f"{preset}/{method}"]
    rows = tuple(compare_settings(upstream_settings()[column], cfg, _keys()))
    reasons = {reason for row in rows for reason in row.reasons}
    beyond = tuple(note for note in cfg.preset.absent.values() if note not in reasons)
    return Comparison(preset, method, column, rows, beyond)


def compare_settings(upstream: Mapping[str, Any], cfg: DictConfig, mapping: Mapping[str, Any]) -> Iterator[Row]:
    """A row for each of upstream's settings; ``mapping`` is as in drivestudio_keys.yaml."""
    flat = _with_items(flat_config(resolved(cfg)))
    notes = cfg.preset.get("absent", {})
    for key, value in upstream.items():
        entry = mapping["keys"].get(key, {})
        entry = {"ours": entry} if isinstance(entry, str) else entry
        there = [one for one in alternatives(entry.get("ours", "")) if one in flat]
        values = [_in_upstreams_terms(flat[one], entry, flat["schedule.max_steps"]) for one in there]
        here = values[0] if values and values == values[:1] * len(values) else values or None
        verdict = "absent" if not there else "equal" if _same(value, here) else "differs"
        lacks = tuple(notes[name] for name in _whose(mapping["lacks"], key) if name in notes)
        reasons = (*lacks, *_whose(mapping["because"], key))
        yield Row(key, value, _joined(there), here, verdict, reasons, said=bool(lacks))


def problems(rows: tuple[Row, ...]) -> list[str]:
    """A line for each row that lacks its reason, has several, or has one and is equal."""
    due = {"equal": 0, "differs": 1, "absent": 1}
    return [
        f"{row.key} {row.verdict} (upstream {row.upstream}, here {row.here}), with {len(row.reasons)} reasons"
        for row in rows
        if len(row.reasons) != due[row.verdict]
    ]


@cache
def upstream_settings() -> dict[str, dict[str, Any]]:
    """File of upstream's -> its keys and values."""
    lines = (line for line in SETTINGS.read_text().splitlines() if not line.startswith("#"))
    (_, *files), *rows = csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE)
    cells = {file: [(row[0], row[column]) for row in rows] for column, file in enumerate(files, start=1)}
    return {file: {key: _value(cell) for key, cell in found if cell != NOTHING} for file, found in cells.items()}


@cache
def _keys() -> dict[str, Any]:
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(KEYS)))


def alternatives(ours: str) -> list[str]:
    """``node.a|b.rate`` as the keys that it stands for.

    >>> alternatives("node.background|rigid.sh_degree")
    ['node.background.sh_degree', 'node.rigid.sh_degree']
    """
    return [".".join(parts) for parts in itertools.product(*(part.split("|") for part in ours.split(".")))]


def _joined(keys: list[str]) -> str | None:
    """The opposite of ``alternatives``; None without keys."""
    columns = zip(*(key.split(".") for key in keys), strict=True)
    return ".".join("|".join(dict.fromkeys(parts)) for parts in columns) or None


def _whose(reasons: Mapping[str, list[str]], key: str) -> list[str]:
    return [name for name, patterns in reasons.items() if any(fnmatchcase(key, one) for one in patterns)]


def _with_items(flat: dict[str, Any]) -> dict[str, Any]:
    """With the items of lists as keys of their own: ``data.log.lidar_ahead.0``."""
    lists = {key: value for key, value in flat.items() if isinstance(value, list)}
    return flat | {f"{key}.{index}": item for key, items in lists.items() for index, item in enumerate(items)}


def _in_upstreams_terms(value: Any, entry: Mapping[str, Any], max_steps: int) -> Any:
    """As the entry of the mapping says; a value that is not among those of ``read`` stays what it is."""
    if "steps" in entry:
        return round(value * max_steps) + entry["steps"]
    if "per" in entry:
        return value / entry["per"]
    return {str(ours): upstream for ours, upstream in entry.get("read", {}).items()}.get(str(value), value)


def _same(upstream: Any, here: Any) -> bool:
    if isinstance(upstream, bool) or isinstance(here, bool):
        return upstream is here
    if isinstance(upstream, int | float) and isinstance(here, int | float):
        return math.isclose(upstream, here, rel_tol=1e-9)  # quotients of decimal numbers
    return upstream == here


def _value(cell: str) -> Any:
    """A number, a truth value or a list as it is written, else a word."""
    try:
        return ast.literal_eval(cell)
    except (ValueError, SyntaxError):
        return cell


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
