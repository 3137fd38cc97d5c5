"""The curves of a run that was stopped and went on stay whole."""

import csv
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sparsestreet.atomic import atomic_file

Rows = list[dict[str, str]]


@contextmanager
def kept_curves(path: Path, resumed_at: int | None) -> Iterator[None]:
    """While training goes on, keep what ``metrics.csv`` said of the steps before ``resumed_at``; None: a new run.

    Lightning's CSV logger begins its file anew. What an earlier part logged behind the checkpoint is left out: those
    steps are taken again.
    """
    earlier = [] if resumed_at is None else [row for row in _read(path) if int(row["step"]) < resumed_at]
    try:
        yield
    finally:
        if earlier:
            _write(path, earlier + _read(path))


def _read(path: Path) -> Rows:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _write(path: Path, rows: Rows) -> None:
    """All columns that any row has, in order of appearance."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_file(path) as temporary:
        temporary.write_text(buffer.getvalue())
