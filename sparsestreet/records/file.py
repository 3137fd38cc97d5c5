"""The files of a run's folder. One value stands for each: it knows the path, checks what it reads and writes whole."""

import csv
import io
import os
import typing
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Generic, TypeVar

from sparsestreet.atomic import check_regular
from sparsestreet.records.strict_json import RecordError, read_json, write_atomically, write_json

FOLDERS = (".hydra", "checkpoints", "records", "predictions", "curves", "pictures")
"""Those in the folder of a run."""

Record = TypeVar("Record")
Row = TypeVar("Row")


def check_links(run: Path) -> None:
    """Raise OSError, naming it, for a link in a run's folder that leads out of it: nothing is written through one.

    A run may come from anybody. The folder itself may be a link, which its user made.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     Path(folder, "records").symlink_to("/somewhere")
    ...     check_links(Path(folder))  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    OSError: records is a link out of the run's folder, to /somewhere: nothing was written, put a copy in its place
    """
    inside = os.path.realpath(run)
    places = [run, *(Path(at) for name in FOLDERS if not (run / name).is_symlink() for at, *_ in os.walk(run / name))]
    for path in sorted(entry for place in places if place.is_dir() for entry in place.iterdir()):
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(inside):
            raise OSError(
                f"{path} is a link out of the run's folder, to {os.path.realpath(path)}: nothing was written, put a "
                "copy in its place"
            )


@dataclass(frozen=True)
class RunFile:
    """A file that a run may have.

    >>> str(RunFile("records/summary.json").path(Path("outputs/run")))
    'outputs/run/records/summary.json'
    """

    name: str
    """Its path within the run's folder."""

    def path(self, run: Path) -> Path:
        """Return its path in the folder of a run."""
        return run / self.name

    def exists(self, run: Path) -> bool:
        """Whether a run has the file."""
        return self.path(run).is_file()

    def remove(self, run: Path) -> None:
        """Remove the file from a run that has it."""
        self.path(run).unlink(missing_ok=True)

    def runs(self, root: Path) -> list[Path]:
        """Return the run folders below ``root`` that have the file, sorted."""
        depth = len(Path(self.name).parts) - 1
        return [path.parents[depth] for path in sorted(root.rglob(self.name))]


@dataclass(frozen=True)
class JsonFile(RunFile, Generic[Record]):
    """A frozen dataclass as JSON; see ``strict_json``.

    >>> import tempfile
    >>> from sparsestreet.records.run import FAILURE, FailedRun
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     FAILURE.write(Path(folder), FailedRun(label="3dgs", seed=0, command="train", error="no log", trace=""))
    ...     FAILURE.read(Path(folder)).error
    'no log'
    """

    kind: type[Record]

    def read(self, run: Path) -> Record:
        """Return the record of a run. Raises RecordError that names the absent file, or the file and the bad entry."""
        return read_json(self.path(run), self.kind)

    def find(self, run: Path) -> Record | None:
        """Return the same as ``read``, or None for a run without the file."""
        return self.read(run) if self.exists(run) else None

    def write(self, run: Path, record: Record) -> None:
        """Write the whole file or nothing. Raises RecordError for values that JSON cannot hold."""
        write_json(self.path(run), record)


@dataclass(frozen=True)
class CsvFile(RunFile, Generic[Row]):
    """Comma-separated rows under a header that is checked.

    >>> import tempfile
    >>> from sparsestreet.records.curves import LEDGER, CountChange
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     LEDGER.write(Path(folder), [CountChange(100, "background", 5000, 4000, "cull")])
    ...     LEDGER.read(Path(folder))[0].after
    4000
    """

    columns: tuple[str, ...]
    cells: Callable[[Row], Sequence[object]]
    """Turns a row into its cells, None for a blank one. Raises RecordError naming an entry that cannot be written."""
    row: Callable[[Sequence[str]], Row]
    """Turns cells, one a column, into a row. Raises ValueError that says what is wrong."""
    remedy: str
    """How to make the file, such as "train the run"."""

    def read(self, run: Path) -> list[Row]:
        """Return the rows of a run. Raises RecordError that names the absent file, or the file and the bad line."""
        path = self.path(run)
        if not path.is_file():
            raise RecordError(f"{path}: does not exist; {self.remedy} first")
        lines = csv_lines(path, self.remedy)
        if not lines or tuple(lines[0]) != self.columns:
            raise RecordError(
                f"{path}: the header is {lines[:1]}, expected {','.join(self.columns)}; {self.remedy} again"
            )
        return [self._parsed(cells, f"{path}, line {number}") for number, cells in enumerate(lines[1:], start=2)]

    def find(self, run: Path) -> list[Row] | None:
        """Return the same as ``read``, or None for a run without the file."""
        return self.read(run) if self.exists(run) else None

    def write(self, run: Path, rows: Iterable[Row]) -> None:
        """Write the whole file or nothing. Raises RecordError naming the file and an entry that cannot be written."""
        self.write_to(self.path(run), rows)

    def write_to(self, path: Path, rows: Iterable[Row]) -> None:
        """Does the same as ``write``, at a path of the caller's choice."""
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


def table_of(name: str, kind: type[Row], remedy: str, **formats: str) -> CsvFile[Row]:
    """Return the table of a flat dataclass: a column for each field, written in its format if one is given.

    >>> from sparsestreet.records.curves import CountChange
    >>> table_of("counts.csv", CountChange, "train the run", after="08.1f").cells(CountChange(1, "sky", 2, 3, "cull"))
    ['1', 'sky', '2', '000003.0', 'cull']
    """
    kinds = {field: typing.get_args(hint) or (hint,) for field, hint in typing.get_type_hints(kind).items()}

    def cells(row: Row) -> list[str | None]:
        values = {field: getattr(row, field) for field in kinds}
        return [None if one is None else format(one, formats.get(field, "")) for field, one in values.items()]

    def row(cells: Sequence[str]) -> Row:
        read = zip(kinds.values(), cells, strict=True)
        return kind(*(None if NoneType in some and not text else some[0](text) for some, text in read))

    return CsvFile(name, tuple(kinds), cells, row, remedy)


def csv_lines(path: Path, remedy: str) -> list[list[str]]:
    """Cells of each line. Raises RecordError, naming the file and how to make it, for what is no text."""
    check_regular(path)
    try:
        # As bytes, because a cell may hold ends of lines.
        return list(csv.reader(io.StringIO(path.read_bytes().decode("utf-8"), newline="")))
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordError(f"{path}: cannot be read ({error}); {remedy} again") from error


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return comma-separated lines; a cell that is None stays blank.

    >>> csv_text(("step", "psnr"), [(100, 24.5), (200, None)])
    'step,psnr\\n100,24.5\\n200,\\n'
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
