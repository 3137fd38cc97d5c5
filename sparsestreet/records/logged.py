"""``curves/metrics.csv``: what training logged, as Lightning's CSV logger writes it."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.file import RunFile, csv_text
from sparsestreet.records.strict_json import write_atomically

Logged = dict[str, str]
"""Column -> text; blank where a row has no value."""


@dataclass(frozen=True)
class LoggedFile(RunFile):
    """Rows whose columns are whatever training logs."""

    def rows(self, run: Path) -> list[Logged]:
        """Returns all rows; none for a run without the file."""
        if not self.exists(run):
            return []
        with self.path(run).open(newline="") as file:
            return list(csv.DictReader(file))

    def write(self, run: Path, rows: Sequence[Logged]) -> None:
        """Writes the whole file or nothing, with every column that any row has, in order of appearance."""
        columns = list(dict.fromkeys(name for row in rows for name in row))
        write_atomically(self.path(run), csv_text(columns, [[row.get(name) for name in columns] for row in rows]))


LOGGED = LoggedFile("curves/metrics.csv")
