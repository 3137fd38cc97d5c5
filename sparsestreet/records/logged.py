"""``curves/metrics.csv``: what training logged, as Lightning's CSV logger writes it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.file import RunFile, csv_lines, csv_text
from sparsestreet.records.strict_json import write_atomically

Logged = dict[str, str]
"""Column -> text; blank where a row has no value."""


@dataclass(frozen=True)
class LoggedFile(RunFile):
    """Rows whose columns are whatever training logs."""

    def rows(self, run: Path) -> list[Logged]:
        """Returns all rows; none for a run without the file. What a kill left of a line is none.

        Raises RecordError for what is no text.
        """
        if not self.exists(run):
            return []
        head, *lines = csv_lines(self.path(run), "remove it, or train the run") or [[]]
        rows = [dict(zip(head, line, strict=True)) for line in lines if len(line) == len(head)]
        return [row for row in rows if row.get("step", "").isdecimal()]

    def write(self, run: Path, rows: Sequence[Logged]) -> None:
        """Writes the whole file or nothing, with every column that any row has, in order of appearance."""
        columns = list(dict.fromkeys(name for row in rows for name in row))
        write_atomically(self.path(run), csv_text(columns, [[row.get(name) for name in columns] for row in rows]))


LOGGED = LoggedFile("curves/metrics.csv")
