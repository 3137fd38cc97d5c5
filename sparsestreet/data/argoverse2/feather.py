"""Columns of numbers and text out of feather files (Arrow's format for files)."""

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from sparsestreet.data.problems import LogError, fault

MAX_BYTES = 64_000_000
"""Bytes of a file. The largest of the data set, a sweep, takes about 2 MB."""
_REMEDY = "fetch the file again from its publisher"


def read_columns(path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Return columns by name, each float64, int64 or text (object), as ``columns`` says: float, int or str.

    Raises LogError for a missing or broken file, a column that lacks or has empty cells or another type, and for a file
    of more than MAX_BYTES; ModuleNotFoundError without pyarrow.
    """
    arrow = pyarrow_of()
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY)
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise fault(path, f"the file has {size:,} bytes, more than the {MAX_BYTES:,} that are read", _REMEDY)
        return _decoded(arrow, path, columns)
    except (arrow.ArrowException, OSError, ValueError) as broken:
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
