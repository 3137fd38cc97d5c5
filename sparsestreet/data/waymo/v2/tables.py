"""Tables of a component in parquet files: small columns whole, large cells one at a time."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any

from sparsestreet.atomic import check_regular
from sparsestreet.data.frame_cache import Lock
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.waymo.segment import REMEDY
from sparsestreet.data.waymo.spool import Spool

SEGMENT, FRAME = "key.segment_context_name", "key.frame_timestamp_micros"
CAMERA, LASER, OBJECT = "key.camera_name", "key.laser_name", "key.laser_object_id"
_LARGEST_TABLE = 256_000_000
"""Bytes of small columns that are held at once; those of a segment take a few million."""
_BYTES_OF_A_ROW, _BYTES_OF_A_CELL = 256, 64
"""What Python takes for either at least, however few bytes code them: sixty million equal cells fit into 400 kB."""
_ROWS_AT_ONCE = 4
_READ_AHEAD = 1 << 20
"""Bytes of a column that are read from the file at a time."""


class Table:
    """A component of a segment. All methods raise LogError, naming the file, for broken ones."""

    def __init__(self, path: Path, component: str) -> None:
        """``component``: the name that stands in brackets before its columns, such as CameraImageComponent."""
        self.path = path
        self._prefix = f"[{component}]."
        self._file = _opened(path)
        self._reading = Lock()
        self.columns: set[str] = self._explained(lambda: set(self._file.schema_arrow.names))

    def column(self, name: str) -> str:
        """The name of a column as the file has it; a key keeps its own."""
        return name if name.startswith("key.") else self._prefix + name

    def rows(self, keys: Sequence[str], columns: Sequence[str]) -> list[dict[str, Any]]:
        """Some columns of all rows, in Python's numbers, texts and lists."""
        wanted = [*keys, *columns]
        names = [self.column(name) for name in wanted]
        self._require(names)
        cells = self._explained(lambda: self._cells(names, *self._sizes(names)))
        return [dict(zip(wanted, row, strict=True)) for row in zip(*cells, strict=True)]

    def spooled(
        self, places: dict[Any, int], columns: Sequence[str], pack: Callable[[list[Any]], bytes]
    ) -> Callable[[Any], bytes]:
        """A function from a key to what ``pack`` made of its row.

        A group of rows is decoded from its start when one of its rows is asked for, a few rows at a time, and what was
        packed is kept in a temporary file: groups may be large.

        Args:
            places: key -> row of the file.
            columns: those that ``pack`` gets, in this order, as one Arrow scalar each.
            pack: of the cells of a row.
        """
        names = [self.column(name) for name in columns]
        self._require(names)
        keys, spool = {place: key for key, place in places.items()}, Spool()

        def keep(row: int) -> None:
            for place, cells in self._group_around(row, names):
                if place in keys:
                    spool.put(keys[place], pack(cells))

        def read(key: Any) -> bytes:
            with self._reading:
                if key not in spool:
                    self._explained(lambda: keep(places[key]))
            return spool.get(key)

        return read

    def _group_around(self, row: int, names: Sequence[str]) -> Iterator[tuple[int, list[Any]]]:
        """Place and cells of each row of the group that holds a row."""
        metadata = self._file.metadata
        counts = [metadata.row_group(number).num_rows for number in range(metadata.num_row_groups)]
        firsts = list(accumulate(counts, initial=0))
        number = bisect_right(firsts, row) - 1
        place = firsts[number]
        for batch in self._file.iter_batches(_ROWS_AT_ONCE, row_groups=[number], columns=names, use_threads=False):
            cells = [batch.column(name) for name in names]
            for inside in range(batch.num_rows):
                yield place + inside, [column[inside] for column in cells]
            place += batch.num_rows

    def _require(self, names: Sequence[str]) -> None:
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise fault(self.path, f"the columns {missing[:4]} are missing", REMEDY)

    def _cells(self, names: Sequence[str], coded: int, decoded: int) -> list[list[Any]]:
        """The cells of columns, read so few rows at a time that none of the steps takes more than the largest table."""
        self._check_size(names, decoded)
        columns: list[list[Any]] = [[] for _ in names]
        # No cell is larger than the bytes that code all of them.
        rows = max(1, min(_LARGEST_TABLE // max(coded, 1), 65536))
        for batch in self._file.iter_batches(rows, columns=names, use_threads=False):
            decoded += batch.nbytes
            self._check_size(names, decoded)
            for cells, name in zip(columns, names, strict=True):
                cells += batch.column(name).to_pylist()
        return columns

    def _check_size(self, names: Sequence[str], size: int) -> None:
        if size > _LARGEST_TABLE:
            message = f"the columns {', '.join(names[:3])} ... take {size} bytes, a segment's take a few million"
            raise fault(self.path, message, REMEDY)

    def _sizes(self, names: Sequence[str]) -> tuple[int, int]:
        """Bytes that code the columns, and the least that they take in memory."""
        metadata, size, values = self._file.metadata, 0, 0
        for number in range(metadata.num_row_groups):
            group = metadata.row_group(number)
            chunks = [group.column(place) for place in range(group.num_columns)]
            # A list's column is told by its path: NAME.list.element.
            wanted = [
                chunk
                for chunk in chunks
                if chunk.path_in_schema.removesuffix(".list.element").removesuffix(".list.item") in names
            ]
            size += sum(chunk.total_uncompressed_size for chunk in wanted)
            values += sum(chunk.num_values for chunk in wanted)
        return size, size + _BYTES_OF_A_ROW * metadata.num_rows + _BYTES_OF_A_CELL * values

    def _explained(self, read: Callable[[], Any]) -> Any:
        """What ``read`` returns; errors of Arrow as those of the file."""
        import pyarrow

        try:
            return read()
        except LogError:
            raise
        except (pyarrow.ArrowException, OSError, ValueError, UnicodeDecodeError) as error:
            raise _unreadable(self.path, error) from error


def data_of(cell: Any, path: Path) -> bytes:
    """The bytes of an Arrow cell, none where it is empty."""
    value = cell.as_py() or b""
    if not isinstance(value, bytes):
        raise fault(path, f"a cell of the type {cell.type} holds no bytes", REMEDY)
    return value


def _opened(path: Path) -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        message = "tables in parquet files need pyarrow, which is not installed"
        raise fault(path, message, "pip install 'sparsestreet[parquet]'") from error
    try:
        check_regular(path)
        return pyarrow.parquet.ParquetFile(path, buffer_size=_READ_AHEAD, pre_buffer=False)
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> LogError:
    first = str(error).strip().splitlines() or [type(error).__name__]
    return fault(path, f"the table cannot be read ({first[0][:200]})", REMEDY)
