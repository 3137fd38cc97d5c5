"""Points from a .ply file: positions, and colors where it has them."""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, fault

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_HEADER_LINES = 200
_LINE = 4096
"""Bytes of a header's line, and of a point's in text."""
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_REMEDY = "write a .ply whose first element is vertex, with x, y, z (and red, green, blue), in text or binary"


def read_ply(path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Positions, and RGB in [0, 1] (gray 0.5 without colors). Raises LogError for any file that is not of such points.

    No memory is taken that the file's own size does not justify.
    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            order, count, columns = _header(file, path)
            size = path.stat().st_size - file.tell()
            least = count * (np.dtype(columns).itemsize if order != "ascii" else 2 * len(columns))
            if least > size:
                message = f"the header says {count:,} points, which take {least:,} bytes, but {size:,} follow it"
                raise fault(path, message, "write the file again: it is cut short")
            read: Callable = _text_rows if order == "ascii" else _binary_rows
            rows = read(file, count, columns, path)
    except OSError as error:
        raise fault(path, f"the file cannot be read ({error})", "write it again, or leave its name out") from error
    positions = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], 1)
    return torch.from_numpy(positions), torch.from_numpy(_colors(rows, dict(columns)))


def _header(file: BinaryIO, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """How the points are written, how many there are, and the columns of one."""
    order, count, columns, element = "", -1, [], None
    for number in range(_HEADER_LINES):
        words = file.readline(_LINE).decode("ascii", "replace").split()
        if number == 0 and words != ["ply"]:
            raise fault(path, "the file does not start with the line 'ply'", _REMEDY)
        if words[:1] == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) == 3 and words[1] in _ORDERS:
            order = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1] if element is None else "behind the points"
            if element == "vertex" and words[2].isdecimal() and len(words[2]) < 13:
                count = int(words[2])
        elif words[:1] == ["property"] and element == "vertex":
            columns.append(_column(words, order, path))
    else:
        raise fault(path, f"the header does not end within {_HEADER_LINES} lines", _REMEDY)
    names = [name for name, _ in columns]
    if not order or count < 0 or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise fault(path, "the header does not describe points with x, y, z", _REMEDY)
    return order, count, columns


def _column(words: list[str], order: str, path: Path) -> tuple[str, str]:
    if len(words) != 3 or words[1] not in _TYPES:
        raise fault(path, f"a point has {' '.join(words)[:60]!r}, which is no number", _REMEDY)
    return words[2], _ORDERS.get(order, "=") + _TYPES[words[1]]


def _binary_rows(file: BinaryIO, count: int, columns: list[tuple[str, str]], path: Path) -> np.ndarray:
    return np.fromfile(file, dtype=columns, count=count)


def _text_rows(file: BinaryIO, count: int, columns: list[tuple[str, str]], path: Path) -> np.ndarray:
    rows = np.empty(count, dtype=[(name, "f8") for name, _ in columns])
    for index in range(count):
        words = file.readline(_LINE).split()
        try:
            rows[index] = tuple(float(word) for word in words[: len(columns)])
        except (ValueError, OverflowError) as error:
            raise _broken_row(path, index, len(columns), words) from error
        if len(words) != len(columns):
            raise _broken_row(path, index, len(columns), words)
    return rows


def _broken_row(path: Path, index: int, wanted: int, words: list[bytes]) -> LogError:
    found = b" ".join(words)[:60].decode("ascii", "replace")
    return fault(path, f"point {index} is {found!r}, not {wanted} numbers", "write the file again")


def _colors(rows: np.ndarray, types: dict[str, str]) -> np.ndarray:
    """RGB in [0, 1]: counts of 0 to 255, unless they are fractions."""
    if not {"red", "green", "blue"} <= types.keys():
        return np.full((len(rows), 3), 0.5, dtype=np.float32)
    colors = np.stack([rows[name].astype(np.float32) for name in ("red", "green", "blue")], 1)
    kind = np.dtype(types["red"])
    if kind.kind != "f":
        colors = colors / np.float32(np.iinfo(kind).max)
    return np.nan_to_num(colors, nan=0.5).clip(0, 1)
