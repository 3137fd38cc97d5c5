"""Points from a .ply file: positions, and colors where it has them."""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
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
_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Of colors, in the order in which they are looked for; then those of Gaussians."""
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
_Y00 = 0.28209479177387814
"""The constant harmonic, 1 / sqrt(4 pi)."""
_ONE = 1.001
"""The largest of fractions, rounded by whoever wrote them."""
_REMEDY = "write a .ply whose first element is vertex, with x, y, z (and red, green, blue), in text or binary"


def read_ply(path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return positions, and RGB in [0, 1] (gray 0.5 without colors; of Gaussians, their constant term).

    Raises LogError for any file that is not of such points.

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


def _colors(rows: np.ndarray, types: dict[str, str]) -> Float32[np.ndarray, "n 3"]:
    """RGB in [0, 1], whatever its columns are called and counted in; gray where it is not a number."""
    names = next((names for names in (*_NAMES, _HARMONICS) if set(names) <= types.keys()), None)
    if names is None or not len(rows):
        return np.full((len(rows), 3), 0.5, dtype=np.float32)
    colors = np.stack([rows[name].astype(np.float64) for name in names], 1)
    if names == _HARMONICS:
        colors = 0.5 + _Y00 * colors
    else:
        colors /= _full(np.dtype(types[names[0]]), colors)
    return np.nan_to_num(colors, nan=0.5).clip(0, 1).astype(np.float32)


def _full(kind: np.dtype, colors: np.ndarray) -> float:
    """What white is: told by the type of bytes alone, else by the largest value too, as many write bytes in others."""
    if kind.itemsize == 1:
        return float(np.iinfo(kind).max)
    largest = colors.max(initial=0.0, where=np.isfinite(colors))
    if kind.kind == "f" and largest <= _ONE:
        return 1.0
    return next((float(full) for full in (255, 65535) if largest <= full), float(largest))
