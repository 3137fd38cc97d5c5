"""Tables as pandas 1.0 pickled them, which all later versions read, written without pandas: step by step."""

import pickle
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_PROTOCOL = b"\x80\x03"
"""The first of Python 3."""
_OBJECTS = "O8"


@dataclass(frozen=True)
class _Name:
    """Something that the reader imports."""

    module: str
    name: str


@dataclass(frozen=True)
class _Call:
    """A call of a name, or of its ``__new__``, and the state that is set afterwards."""

    name: _Name
    arguments: tuple[Any, ...]
    state: Any = None
    new: bool = False


def pickled_table(columns: Mapping[str, np.ndarray | Sequence[str]]) -> bytes:
    """A DataFrame of columns of equal lengths: arrays of float64, int64 or bool, or lists of text."""
    arrays = {name: _column(values) for name, values in columns.items()}
    names, count = list(arrays), len(next(iter(arrays.values())))
    blocks = [
        {
            "values": np.stack([arrays[names[place]] for place in places]),
            "mgr_locs": np.array(places, np.int64),
        }
        for kind in dict.fromkeys(array.dtype for array in arrays.values())
        for places in [[place for place, name in enumerate(names) if arrays[name].dtype == kind]]
    ]
    rows = {"name": None, "start": 0, "stop": count, "step": 1}
    index = _Name("pandas.core.indexes.base", "_new_Index")
    axes = [
        _Call(index, (_Name("pandas.core.indexes.base", "Index"), {"data": _column(names), "name": None})),
        _Call(index, (_Name("pandas.core.indexes.range", "RangeIndex"), rows)),
    ]
    # What stands before is of pandas up to 0.14, and is passed over by later ones.
    state = ([], [], [], {"0.14.1": {"axes": axes, "blocks": blocks}})
    manager = _Call(_Name("pandas.core.internals.managers", "BlockManager"), (), state, new=True)
    described = {"_data": manager, "_typ": "dataframe", "_metadata": [], "attrs": {}}
    table = _Call(_Name("pandas.core.frame", "DataFrame"), (), described, new=True)
    return b"".join((_PROTOCOL, *_steps(table), pickle.STOP))


def _column(values: np.ndarray | Sequence[str]) -> np.ndarray:
    if isinstance(values, np.ndarray):
        return values
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array


def _steps(value: Any) -> Iterator[bytes]:
    """Opcodes that make the value."""
    if isinstance(value, _Name):
        yield pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode()
    elif isinstance(value, _Call):
        yield from _steps(value.name)
        yield from _steps(value.arguments)
        yield pickle.NEWOBJ if value.new else pickle.REDUCE
        if value.state is not None:
            yield from _steps(value.state)
            yield pickle.BUILD
    elif isinstance(value, np.ndarray):
        yield from _steps(_array(value))
    elif isinstance(value, dict):
        yield pickle.EMPTY_DICT + pickle.MARK
        for pair in value.items():
            for one in pair:
                yield from _steps(one)
        yield pickle.SETITEMS
    elif isinstance(value, list | tuple):
        yield pickle.EMPTY_LIST + pickle.MARK if isinstance(value, list) else pickle.MARK
        for one in value:
            yield from _steps(one)
        yield pickle.APPENDS if isinstance(value, list) else pickle.TUPLE
    else:
        yield _step(value)


def _step(value: bool | int | str | bytes | None) -> bytes:
    match value:
        case None:
            return pickle.NONE
        case bool():
            return pickle.NEWTRUE if value else pickle.NEWFALSE
        case int():
            return pickle.BININT + struct.pack("<i", value)
        case str():
            text = value.encode("utf-8", "surrogatepass")
            return pickle.BINUNICODE + struct.pack("<I", len(text)) + text
        case bytes():
            return pickle.BINBYTES + struct.pack("<I", len(value)) + value


def _array(array: np.ndarray) -> _Call:
    """As NumPy itself pickles one, by the name that its versions 1 and 2 know."""
    kind = _OBJECTS if array.dtype == object else array.dtype.str[1:]
    # Version, order of bytes, no parts, size and alignment of the type, flags: 63 is that of objects.
    order = "|" if kind in (_OBJECTS, "b1") else "<"
    described = (3, order, None, None, None, -1, -1, 63 if kind == _OBJECTS else 0)
    dtype = _Call(_Name("numpy", "dtype"), (kind, False, True), described)
    content = array.ravel().tolist() if kind == _OBJECTS else array.astype(array.dtype.newbyteorder("<")).tobytes()
    empty = (_Name("numpy", "ndarray"), (0,), b"b")
    return _Call(_Name("numpy.core.multiarray", "_reconstruct"), empty, (1, array.shape, dtype, False, content))
