"""Columns out of pickled tables of pandas: without pandas, and without running anything in the file.

A table is blocks of columns of one type, with the places of these columns. Pandas 0.25 to 1.2, which wrote the data
set, put them into a state; later versions into the arguments of a call. Both are taken apart here.
"""

import gzip
import zlib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sparsestreet.data.problems import fault
from sparsestreet.safe_pickle import Made, array_of_numbers, unpickled

LARGEST = 64_000_000
"""Bytes of a decompressed table. A sweep of 200,000 returns takes 10 MB."""
MOST_STEPS = 200_000
"""Of the unpickler. Text takes two a cell: 20 a cuboid, of which an instant has some hundred."""
_FRAME, _MANAGER = "pandas.core.frame.DataFrame", "pandas.core.internals.managers.BlockManager"
_BLOCK, _SLICES = "pandas._libs.internals._unpickle_block", ("builtins.slice", "__builtin__.slice")
_INDEX, _SCALAR = "pandas.core.indexes.base._new_Index", "numpy._core.multiarray.scalar"
_INDICES = (
    "pandas.core.indexes.base.Index",
    "pandas.core.indexes.range.RangeIndex",
    "pandas.core.indexes.numeric.Int64Index",
)
_NAMES = (_FRAME, _MANAGER, _BLOCK, *_SLICES, _INDEX, *_INDICES)
_REMEDY = "fetch the file again, or write the table with pandas 2 and plain columns (to_pickle)"


def read_columns(path: Path, columns: Mapping[str, type]) -> dict[str, np.ndarray]:
    """Columns by name, each float64, int64, bool or text (object), as ``columns`` says: float, int, bool or str.

    A cell without text is "". Raises LogError for a missing or broken file, one that holds anything but a table, a
    column that lacks or is of another type, and a file of more than LARGEST.
    """
    content = _content(path)
    try:
        return dict(_wanted(unpickled(content, _NAMES, max_steps=MOST_STEPS), columns))
    except Exception as error:  # each step of a broken pickle fails in its own way
        reason = f"{type(error).__name__}: {error}"[:300]
        raise fault(path, f"the file is no pickled table of plain columns ({reason})", _REMEDY) from error


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY)
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            content = file.read(LARGEST + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise fault(path, f"the file cannot be decompressed ({error})", _REMEDY) from error
    if len(content) > LARGEST:
        raise fault(path, f"the table takes more than {LARGEST / 1e6:.0f} MB, as no sweep does", _REMEDY)
    return content


def _wanted(table: Any, columns: Mapping[str, type]) -> Iterator[tuple[str, np.ndarray]]:
    names, blocks = _parts(table)
    if len(set(names)) < len(names):
        raise ValueError("two columns have one name")
    if absent := [name for name in columns if name not in names]:
        raise ValueError(f"it has no column {', '.join(absent)}, but {', '.join(name[:40] for name in names[:20])}")
    found: dict[str, np.ndarray | list[Any]] = {}
    for values, places in blocks:
        held = [names[place] for place in places]
        if wanted := [name for name in held if name in columns]:
            rows = _rows(values, len(held))
            found |= {name: rows[held.index(name)] for name in wanted}
    if absent := [name for name in columns if name not in found]:
        raise ValueError(f"no block holds column {', '.join(absent)}")
    if len({len(cells) for cells in found.values()}) > 1:
        raise ValueError("columns have different lengths")
    for name, kind in columns.items():
        yield name, _cells(name, found[name], kind)


def _parts(table: Any) -> tuple[list[str], list[tuple[Any, range | np.ndarray]]]:
    """Names of the columns, and each block's values with the places of its columns."""
    state = _made(table, _FRAME).state
    manager = _made(state["_mgr"] if "_mgr" in state else state["_data"], _MANAGER)
    if manager.state is None:
        blocks, axes = manager.arguments
        pairs = [_made(block, _BLOCK).arguments[:2] for block in blocks]
    else:
        inner = manager.state[3]["0.14.1"]
        axes, pairs = inner["axes"], [(block["values"], block["mgr_locs"]) for block in inner["blocks"]]
    names = _index_names(axes[0])
    return names, [(values, _places(place, len(names))) for values, place in pairs]


def _index_names(index: Any) -> list[str]:
    names = _objects(_made(index, _INDEX).arguments[1]["data"])
    if not all(isinstance(name, str) for name in names):
        raise ValueError("its columns have names that are no text")
    return names


def _places(place: Any, count: int) -> range | np.ndarray:
    if isinstance(place, Made) and place.name in _SLICES:
        return range(count)[slice(*place.arguments)]
    places = array_of_numbers(place)
    if places.ndim != 1 or places.dtype.kind != "i" or (places < 0).any() or (places >= count).any():
        raise ValueError("the places of a block's columns are none of the table's")
    return places


def _rows(values: Any, count: int) -> list[Any]:
    """Cells of each column of a block."""
    if isinstance(values, Made) and _is_of_objects(values):
        shape, cells = values.state[1], _objects(values)
        if len(shape) != 2 or shape[0] != count:
            raise ValueError(f"a block of {count} columns has the shape {shape}")
        return [cells[row * shape[1] : (row + 1) * shape[1]] for row in range(count)]
    array = array_of_numbers(values)
    if array.ndim != 2 or len(array) != count:
        raise ValueError(f"a block of {count} columns has the shape {array.shape}")
    return list(array)


def _is_of_objects(values: Made) -> bool:
    return isinstance(values.state, tuple) and len(values.state) == 5 and isinstance(values.state[4], list)


def _objects(values: Any) -> list[Any]:
    """Flat, in the order of rows, whatever order the array has."""
    if not isinstance(values, Made) or not _is_of_objects(values):
        raise ValueError("it has no list for the cells of objects")
    shape, cells = values.state[1], values.state[4]
    # What is wrong may be a list of lists with no end, so it is not printed.
    if not isinstance(shape, tuple) or len(shape) not in (1, 2) or not all(type(length) is int for length in shape):
        raise ValueError("an array of objects has no one or two lengths")
    if min(shape) < 0 or shape[0] * shape[-1] ** (len(shape) - 1) != len(cells):
        raise ValueError(f"an array of {len(cells)} objects has the shape {shape}")
    return cells


def _cells(name: str, cells: np.ndarray | list[Any], kind: type) -> np.ndarray:
    if isinstance(cells, list):
        convert = {str: _text, bool: partial(_cell, (bool,)), int: partial(_cell, (int,))}
        values = [convert.get(kind, partial(_cell, (int, float)))(name, cell) for cell in cells]
        return np.array(values, dtype=object if kind is str else kind)
    if cells.dtype.kind not in {float: "fiu", int: "iu", bool: "b"}.get(kind, ""):
        raise ValueError(f"column {name} holds {cells.dtype}, not {kind.__name__}")
    return cells.astype(kind)


def _text(name: str, cell: Any) -> str:
    """Text, or "" for None and NaN."""
    if cell is None or (isinstance(cell, float) and cell != cell):
        return ""
    return _cell((str,), name, cell)


def _cell(kinds: tuple[type, ...], name: str, cell: Any) -> Any:
    if isinstance(cell, Made) and cell.name == _SCALAR:
        dtype, data = cell.arguments
        cell = array_of_numbers(Made("numpy._core.numeric._frombuffer", (data, dtype, (1,), "C")))[0].item()
    if type(cell) not in kinds:
        raise ValueError(f"column {name} holds a {type(cell).__name__}, not {kinds[-1].__name__}")
    return cell


def _made(value: Any, name: str) -> Made:
    if not isinstance(value, Made) or value.name != name:
        raise ValueError(f"it holds a {value.name if isinstance(value, Made) else type(value).__name__}, not a {name}")
    return value
