"""The files of a run's folder: each has one value that knows its place, reads it checked and writes it whole."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from sparsestreet.records.strict_json import RecordError, read_json, write_atomically, write_json

Record = TypeVar("Record")
Row = TypeVar("Row")


@dataclass(frozen=True)
class RunFile:
    """A file that a run may have."""

    name: str
    """Its path within the run's folder."""

    def path(self, run: Path) -> Path:
        """Where a run keeps it."""
        return run / self.name

    def exists(self, run: Path) -> bool:
        """Whether a run has it."""
        return self.path(run).is_file()

    def remove(self, run: Path) -> None:
        """Remove it where a run has it."""
        self.path(run).unlink(missing_ok=True)

    def runs(self, root: Path) -> list[Path]:
        """The folders below ``root`` that have it, sorted."""
        depth = len(Path(self.name).parts) - 1
        return [path.parents[depth] for path in sorted(root.rglob(self.name))]


@dataclass(frozen=True)
class JsonFile(RunFile, Generic[Record]):
    """A frozen dataclass as JSON; see ``strict_json``."""

    kind: type[Record]

    def read(self, run: Path) -> Record:
        """Raises RecordError naming the file and the entry that is wrong, or the file that is absent."""
        return read_json(self.path(run), self.kind)

    def find(self, run: Path) -> Record | None:
        """As ``read``; None for a run without it."""
        return self.read(run) if self.exists(run) else None

    def write(self, run: Path, record: Record) -> None:
        """Write it whole or not at all. Raises RecordError for values that JSON has no number for."""
        write_json(self.path(run), record)


@dataclass(frozen=True)
class CsvFile(RunFile, Generic[Row]):
    """Comma-separated rows below a header that is checked."""

    columns: tuple[str, ...]
    cells: Callable[[Row], Sequence[object]]
    """The cells of a row as they are written, None for a blank one; RecordError names the entry that cannot be."""
    row: Callable[[Sequence[str]], Row]
    """A row of as many cells as there are columns; ValueError says what is wrong."""
    remedy: str
    """What makes the file, such as "train the run"."""

    def read(self, run: Path) -> list[Row]:
        """Raises RecordError naming the file and the line that is wrong, or the file that is absent."""
        path = self.path(run)
        if not path.is_file():
            raise RecordError(f"{path}: does not exist; {self.remedy} first")
        lines = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
        if not lines or tuple(lines[0]) != self.columns:
            raise RecordError(
                f"{path}: the header is {lines[:1]}, expected {','.join(self.columns)}; {self.remedy} again"
            )
        return [self._parsed(cells, f"{path}, line {number}") for number, cells in enumerate(lines[1:], start=2)]

    def find(self, run: Path) -> list[Row] | None:
        """As ``read``; None for a run without it."""
        return self.read(run) if self.exists(run) else None

    def write(self, run: Path, rows: Iterable[Row]) -> None:
        """Write it whole or not at all. Raises RecordError naming the file and the entry that cannot be written."""
        self.write_to(self.path(run), rows)

    def write_to(self, path: Path, rows: Iterable[Row]) -> None:
        """As ``write``, to a place that a configuration names."""
        try:
            cells = [self.cells(row) for row in rows]
        except RecordError as error:
            raise RecordError(f"{path}: {error}") from error
        write_atomically(path, csv_text(self.columns, cells))

    def _parsed(self, cells: Sequence[str], where: str) -> Row:
        try:
            if len(cells) != len(self.columns):
                raise ValueError(f"{len(cells)} cells, expected {len(self.columns)}")
            return self.row(cells)
        except ValueError as error:
            raise RecordError(f"{where}: {error}; {self.remedy} again") from error


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Comma-separated lines; a cell that is None stays blank."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
