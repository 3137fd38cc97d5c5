"""Columns of numbers and text out of feather files (Arrow's format for files), sizes checked before memory is taken.

A compressed buffer says how large it will be, in its first eight bytes. The file's own metadata say where the buffers
are; they are flatbuffers, of which these few fields are read here (Arrow's File.fbs and Message.fbs).
"""

import mmap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from struct import Struct, error
from types import ModuleType
from typing import Any

import numpy as np

from sparsestreet.data.problems import LogError, fault

LARGEST = 256_000_000
"""Bytes that a table may take in memory. The largest of the data set, the boxes of a log, take about 2 MB."""
_MAGIC = b"ARROW1"
_DICTIONARIES, _BATCHES, _HEADER, _BUFFERS, _COMPRESSION = 2, 3, 2, 2, 3
"""Places of the fields in their flatbuffers: twice of a footer, of a message, and twice of a record batch."""
_SHORT, _INT, _LONG, _BUFFER, _BLOCK = Struct("<H"), Struct("<i"), Struct("<q"), Struct("<qq"), Struct("<qi4xq")
_REMEDY = "fetch the file again from its publisher"


def read_columns(path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Columns by name, each float64, int64 or text (object), as ``columns`` says: float, int or str.

    Raises LogError for a missing or broken file, a column that lacks or has empty cells or another type, and for a file
    that would take more than LARGEST; ModuleNotFoundError without pyarrow.
    """
    arrow = pyarrow_of()
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            needed = sum(_sizes(content))
            if needed > LARGEST:
                message = f"the table would take {needed / 1e6:.0f} MB, more than the {LARGEST / 1e6:.0f} MB allowed"
                raise fault(path, message, _REMEDY)
        return _decoded(arrow, path, columns)
    except (arrow.ArrowException, OSError, ValueError, error, IndexError) as broken:
        if isinstance(broken, LogError):
            raise
        raise fault(path, f"the file is no whole feather file ({_first_line(broken)})", _REMEDY) from broken


def _decoded(arrow: ModuleType, path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    with arrow.OSFile(str(path)) as file:
        schema = arrow.ipc.open_file(file).schema
        if absent := [name for name in columns if schema.get_all_field_indices(name) == []]:
            message = f"the table has no column {', '.join(absent)}, but {', '.join(schema.names[:20])}"
            raise fault(path, message, _REMEDY)
        wanted = sorted(schema.get_field_index(name) for name in columns)
        if wanted[0] < 0:
            raise fault(path, f"the table has two columns of one name among {', '.join(columns)}", _REMEDY)
        for name, kind in columns.items():
            if not _fits(arrow, schema.field(name).type, kind):
                message = f"column {name} holds {schema.field(name).type}, not {_WORDS[kind]}"
                raise fault(path, message, _REMEDY)
        table = arrow.ipc.open_file(file, options=arrow.ipc.IpcReadOptions(included_fields=wanted)).read_all()
        # Lengths in the metadata are believed by whoever indexes an array.
        table.validate(full=True)
    return {name: _values(arrow, path, name, table.column(name), kind) for name, kind in columns.items()}


_WORDS = {float: "numbers", int: "whole numbers", str: "text"}


def _fits(arrow: ModuleType, found: Any, kind: type) -> bool:
    types = arrow.types
    if kind is str:
        return types.is_string(found) or types.is_large_string(found)
    return types.is_integer(found) or (kind is float and types.is_floating(found))


def _values(arrow: ModuleType, path: Path, name: str, column: Any, kind: type) -> np.ndarray:
    if column.null_count:
        raise fault(path, f"column {name} has {column.null_count} empty cells", _REMEDY)
    if kind is str:
        return np.array(column.to_pylist(), dtype=object)
    return column.cast(arrow.int64()).to_numpy() if kind is int else column.to_numpy().astype(np.float64)


def _sizes(content: mmap.mmap) -> Iterator[int]:
    """Bytes of each buffer of a file, decompressed; raises ValueError, IndexError and struct.error for no such file."""
    if content[: len(_MAGIC)] != _MAGIC or content[-len(_MAGIC) :] != _MAGIC:
        raise ValueError("it does not begin and end with ARROW1")
    end = len(content) - len(_MAGIC) - 4
    (length,) = _INT.unpack_from(content, end)
    footer = _Table.root(content, end - length)
    if any(True for _ in footer.vector(_DICTIONARIES, _BLOCK)):
        raise ValueError("it has columns of categories, which are not read: write them as text")
    for start, metadata, _ in footer.vector(_BATCHES, _BLOCK):
        # Eight bytes before the flatbuffer: a mark, and the length of the metadata.
        batch = _Table.root(content, start + 8).table(_HEADER)
        compressed = batch.at(_COMPRESSION) is not None
        for offset, stored in batch.vector(_BUFFERS, _BUFFER):
            size = stored
            if compressed and stored:
                (size,) = _LONG.unpack_from(content, start + metadata + offset)
                # -1: this one is not compressed.
                size = stored if size == -1 else size
            if size < 0:
                raise ValueError(f"a buffer has {size} bytes")
            yield size


@dataclass(frozen=True)
class _Table:
    """A table of a flatbuffer: its first four bytes say how far before it the places of its fields are listed."""

    content: mmap.mmap
    place: int

    @classmethod
    def root(cls, content: mmap.mmap, start: int) -> "_Table":
        return cls(content, _pointed(content, start))

    def at(self, field: int) -> int | None:
        """Where a field is; None where it is left out."""
        listed = self.place - _INT.unpack_from(self.content, _inside(self.place))[0]
        (bytes_listed,) = _SHORT.unpack_from(self.content, _inside(listed))
        if 4 + 2 * field >= bytes_listed:
            return None
        (offset,) = _SHORT.unpack_from(self.content, listed + 4 + 2 * field)
        return self.place + offset if offset else None

    def table(self, field: int) -> "_Table":
        return _Table(self.content, _pointed(self.content, _there(self.at(field))))

    def vector(self, field: int, entry: Struct) -> Iterator[tuple[int, ...]]:
        if (place := self.at(field)) is None:
            return
        start = _pointed(self.content, place)
        (count,) = _INT.unpack_from(self.content, start)
        if count < 0 or start + 4 + count * entry.size > len(self.content):
            raise ValueError(f"a list of {count} entries is cut short")
        for number in range(count):
            yield entry.unpack_from(self.content, start + 4 + number * entry.size)


def _pointed(content: mmap.mmap, place: int) -> int:
    return place + _INT.unpack_from(content, _inside(place))[0]


def _inside(place: int) -> int:
    """A place, which must not be counted from the end; raises ValueError."""
    if place < 0:
        raise ValueError("a part lies before its start")
    return place


def _there(place: int | None) -> int:
    if place is None:
        raise ValueError("a message has no header")
    return place


def _first_line(broken: Exception) -> str:
    return (str(broken).splitlines() or [type(broken).__name__])[0][:200]


def pyarrow_of() -> ModuleType:
    try:
        import pyarrow
        import pyarrow.ipc
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "feather files need pyarrow, which is not installed: pip install 'sparsestreet[parquet]'"
        ) from missing
    return pyarrow
