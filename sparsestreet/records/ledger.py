"""``records/counts.csv``: how the number of Gaussians of each node changed in a training, and why (no torch)."""

import csv
import io
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from sparsestreet.records.strict_json import RecordError, write_atomically

MASK, PRUNING = "mask", "pruning"
"""Reasons of the changes that make a scene small: masks fell to their threshold, a rule named what may go."""


@dataclass(frozen=True)
class CountChange:
    """A line of the ledger."""

    step: int
    node: str
    before: int
    after: int
    reason: str
    """In a word or two: "start", "densify", "cull", ``MASK``, ``PRUNING`` ..."""


_COLUMNS = [field.name for field in fields(CountChange)]


def ledger_path(run: Path) -> Path:
    """Where a run keeps its ledger."""
    return run / "records" / "counts.csv"


def write_changes(path: Path, changes: Iterable[CountChange]) -> None:
    """Write the whole ledger atomically."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(astuple(change) for change in changes)
    write_atomically(path, buffer.getvalue())


def read_changes(path: Path) -> list[CountChange]:
    """Read the ledger back. Raises RecordError naming the file and the line that is wrong."""
    lines = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not lines or lines[0] != _COLUMNS:
        raise RecordError(f"{path}: the header is {lines[:1]}, expected {','.join(_COLUMNS)}; train the run again")
    changes = []
    for number, cells in enumerate(lines[1:], start=2):
        try:
            step, node, before, after, reason = cells
            changes.append(CountChange(int(step), node, int(before), int(after), reason))
        except ValueError as error:
            raise RecordError(f"{path}, line {number}: {error}; train the run again") from error
    return changes
