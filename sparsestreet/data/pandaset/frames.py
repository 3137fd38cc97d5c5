"""Columns out of pickled tables of pandas, without running anything in the file."""

import gzip
import io
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sparsestreet.data.problems import fault
from sparsestreet.pickles import unpickled

MAX_BYTES = 64_000_000
"""Bytes of a decompressed table. A sweep of 200,000 returns takes 10 MB."""
_REMEDY = "fetch the file again, or write the table with pandas and plain columns (to_pickle)"
_INDEX, _RANGE = "index", "range"


def read_columns(path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Return columns by name, each float64, int64, bool or text (object), as ``columns`` says.

    A cell without text is "". Raises LogError for a missing or broken file, one that holds anything but a table, a
    column that lacks or is of another type, and a file of more than MAX_BYTES.
    """
    content = _content(path)
    try:
        table = unpickled(io.BytesIO(content), _names())
        return _wanted(table, columns)
    except Exception as error:  # each step of a broken pickle fails in its own way
        reason = f"{type(error).__name__}: {error}"[:300]
        raise fault(path, f"the file is no pickled table of plain columns ({reason})", _REMEDY) from error


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY)
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise fault(path, f"the file cannot be decompressed ({error})", _REMEDY) from error
    if len(content) > MAX_BYTES:
        raise fault(path, f"the table takes more than {MAX_BYTES / 1e6:.0f} MB, as no sweep does", _REMEDY)
    return content


def _check_places(places: Sequence[Any], num_columns: int) -> None:
    """Raise ValueError unless the blocks of a table, each at a slice or an array of places, hold each column once.

    pandas writes to these places without a look at its bounds: a wrong one overwrites memory.
    """
    found = [range(one.start, one.stop, one.step or 1) if isinstance(one, slice) else one for one in places]
    known = all(isinstance(one, range) or (isinstance(one, np.ndarray) and one.dtype.kind in "iu") for one in found)
    # Their number first: a range may be endless.
    fits = known and sum(map(len, found)) == num_columns
    if not fits or sorted(int(place) for one in found for place in one) != list(range(num_columns)):
        raise ValueError("its blocks do not say which columns they hold")


@cache
def _names() -> dict[str, Any]:
    """Return what a table of pandas 0.25 (which wrote the data set) to 3 may name."""
    import pandas
    import pandas._libs.internals as internals
    from pandas.core.internals import BlockManager

    class Manager(BlockManager):
        def __new__(cls, *arguments: Any) -> "Manager":
            if arguments:
                _check_places([block.mgr_locs.indexer for block in arguments[0]], len(arguments[1][0]))
            return super().__new__(cls, *(arguments or ((), [], False)))

        def __setstate__(self, state: Any) -> None:
            inner = state[3]["0.14.1"]
            check(inner["axes"], pandas.Index)
            check([block["values"] for block in inner["blocks"]], np.ndarray)
            _check_places([block["mgr_locs"] for block in inner["blocks"]], len(inner["axes"][0]))
            super().__setstate__(state)  # pyright: ignore[reportAttributeAccessIssue]

    def check(parts: Any, kind: type) -> None:
        """Refuse lists, which pandas would walk through however often they name each other."""
        if wrong := [type(part).__name__ for part in parts if not isinstance(part, kind)]:
            raise ValueError(f"it holds a {wrong[0]}, not a {kind.__name__}")

    def block(values: Any, *place: Any) -> Any:
        check([values], np.ndarray)
        return internals._unpickle_block(values, *place)  # pyright: ignore[reportAttributeAccessIssue]

    def index(kind: str, state: Mapping[str, Any]) -> Any:
        if kind == _RANGE:
            return pandas.RangeIndex(state["start"], state["stop"], state["step"])
        check([state["data"]], np.ndarray)
        return pandas.Index(np.asarray(state["data"]), dtype=object)

    base = "pandas.core.indexes"
    return {
        "pandas.core.frame.DataFrame": pandas.DataFrame,
        "pandas.core.internals.managers.BlockManager": Manager,
        "pandas._libs.internals._unpickle_block": block,
        f"{base}.base._new_Index": index,
        f"{base}.base.Index": _INDEX,
        f"{base}.numeric.Int64Index": _INDEX,
        f"{base}.range.RangeIndex": _RANGE,
        "builtins.slice": slice,
        "__builtin__.slice": slice,
    }


def _wanted(table: Any, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    import pandas

    if not isinstance(table, pandas.DataFrame):
        raise ValueError(f"it holds a {type(table).__name__}, not a DataFrame")
    table._mgr._verify_integrity()  # pyright: ignore[reportAttributeAccessIssue]
    names = list(table.columns)
    if len(set(names)) < len(names):
        raise ValueError("two columns have one name")
    if absent := [name for name in columns if name not in names]:
        raise ValueError(
            f"it has no column {', '.join(absent)}, but {', '.join(str(name)[:40] for name in names[:20])}"
        )
    return {name: _cells(name, np.asarray(table[name]), kind) for name, kind in columns.items()}


def _cells(name: str, cells: np.ndarray, kind: type) -> np.ndarray:
    if cells.dtype == object:
        values = [_cell(name, cell, kind) for cell in cells.tolist()]
        return np.array(values, dtype=object if kind is str else kind)
    if cells.dtype.kind not in {float: "fiu", int: "iu", bool: "b"}.get(kind, ""):
        raise ValueError(f"column {name} holds {cells.dtype}, not {kind.__name__}")
    return cells.astype(kind)


def _cell(name: str, cell: Any, kind: type) -> Any:
    """Check the cell of a column of objects; text may lack, as None or NaN."""
    value = cell.item() if isinstance(cell, np.generic) else cell
    if kind is str and (value is None or (isinstance(value, float) and value != value)):
        return ""
    if type(value) not in ((int, float) if kind is float else (kind,)):
        raise ValueError(f"column {name} holds a {type(value).__name__}, not {kind.__name__}")
    return value
