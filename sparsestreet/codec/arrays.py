"""Columns of numbers as bytes: plain, as integers of few bits, and read again without trust in their sizes."""

import struct

import numpy as np
from jaxtyping import Integer, Shaped


class Cursor:
    """Reads bytes in order.

    >>> cursor = Cursor(b"abc")
    >>> cursor.take(2), cursor.left
    (b'ab', 1)
    >>> cursor.take(2)
    Traceback (most recent call last):
    ...
    ValueError: 2 bytes should follow, 1 are left: it is damaged
    """

    def __init__(self, content: bytes) -> None:
        self._content, self._place = content, 0

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def take(self, count: int) -> bytes:
        """Return the next bytes. Raises ValueError where there are fewer."""
        if count > self.left:
            raise ValueError(f"{count} bytes should follow, {self.left} are left: it is damaged")
        self._place += count
        return self._content[self._place - count : self._place]

    def numbers(self, form: str) -> tuple:
        """Return the next numbers, in a form of the module ``struct``."""
        return struct.unpack(form, self.take(struct.calcsize(form)))

    def finish(self) -> None:
        """Raise ValueError where bytes are left over."""
        if self.left:
            raise ValueError(f"{self.left} bytes are left over: it is damaged")


_SIGN = np.uint64(1)
_DIFFERENCES = 0x80
"""Set in a column's first byte where it holds each value's difference from the one before."""


def packed(table: Integer[np.ndarray, "n c"]) -> list[bytes]:
    """Return the bytes of a table of int64 values, a piece a column; their concatenation is what is read.

    Small values of both signs become small numbers first (0, -1, 1, -2 ... are 0, 1, 2, 3), so that their high bytes
    are zeros. A column is one byte, the number of bytes a value, and then one byte of each row after the other. Where
    neighbors are alike, differences take fewer bytes, and are stored instead.

    >>> [piece.hex() for piece in packed(np.array([[0], [-1], [1], [300]]))]
    ['020001025800000002']
    """
    pieces = []
    for column in np.asarray(table, np.int64).T:
        steps = np.diff(column, prepend=0)
        smaller = _bits(steps) < _bits(column)
        folded = _folded(steps if smaller else column)
        width = (int(folded.max(initial=0)).bit_length() + 7) // 8
        planes = np.ascontiguousarray(folded).view(np.uint8).reshape(-1, 8)[:, :width]
        pieces.append(bytes([width | (_DIFFERENCES if smaller else 0)]) + planes.T.tobytes())
    return pieces


def unpacked(cursor: Cursor, rows: int, columns: int) -> Integer[np.ndarray, "n c"]:
    """Return the table from where its bytes begin. Raises ValueError where they are not such a table's."""
    table = np.empty((rows, columns), np.int64)
    for index in range(columns):
        (first,) = cursor.take(1)
        width = first & ~_DIFFERENCES
        if width > 8:
            raise ValueError(f"a number of {width} bytes: it is damaged")
        planes = np.zeros((rows, 8), np.uint8)
        planes[:, :width] = np.frombuffer(cursor.take(width * rows), np.uint8).reshape(width, rows).T
        folded = planes.view("<u8")[:, 0]
        column = (folded >> _SIGN).view(np.int64) ^ -(folded & _SIGN).view(np.int64)
        table[:, index] = np.cumsum(column) if first & _DIFFERENCES else column
    return table


def _folded(column: Integer[np.ndarray, " n"]) -> Integer[np.ndarray, " n"]:
    return ((column << 1) ^ (column >> 63)).astype("<u8")


def _bits(column: Integer[np.ndarray, " n"]) -> float:
    """Return about how many bits entropy coding of single bytes would need."""
    folded = _folded(column)
    low, high = folded & np.uint64(0xFF), (folded >> np.uint64(8)) & np.uint64(0xFF)
    return sum(_entropy(part) for part in (low, high)) + 16.0 * float((folded >> np.uint64(16) > 0).sum())


def _entropy(values: Integer[np.ndarray, " n"]) -> float:
    counts = np.bincount(values.astype(np.int64))
    counts = counts[counts > 0]
    return float((counts * np.log2(counts.sum() / counts)).sum())


INTEGERS = ("bool", "uint8", "int16", "int32", "int64")
"""Types that come back bit for bit, and as the same type."""
FLOATS = ("float16", "float32", "float64")
TYPES = INTEGERS + FLOATS


def packed_column(values: Shaped[np.ndarray, "n ..."], step: float | None = None) -> list[bytes]:
    """Return the bytes of an array in pieces.

    With a step, each number is kept in whole steps. Raises ValueError for a type that is none of ``TYPES``.
    """
    if values.dtype.name not in TYPES:
        raise ValueError(f"arrays hold {', '.join(TYPES)}, got {values.dtype.name}")
    rows, width = len(values), int(np.prod(values.shape[1:], dtype=np.int64))
    table = np.ascontiguousarray(values).reshape(rows, width)
    if values.dtype.name in FLOATS and step is None:
        # Bytes of the same place together: those of the exponents are alike.
        planes = np.frombuffer(table.tobytes(), np.uint8).reshape(rows * width, values.dtype.itemsize)
        return [np.ascontiguousarray(planes.T).tobytes()]
    if step is not None:
        return packed(np.rint(table / step).astype(np.int64))
    return packed(table.astype(np.int64))


def unpacked_column(
    cursor: Cursor, rows: int, shape: tuple[int, ...], dtype: str, step: float | None = None
) -> Shaped[np.ndarray, "n ..."]:
    """Return the array from where its bytes begin. Raises ValueError for damaged bytes or another type."""
    if dtype not in TYPES or (step is not None and dtype not in FLOATS):
        raise ValueError(f"arrays hold {', '.join(TYPES)}, got {dtype!r} with a step of {step}: it is damaged")
    width = int(np.prod(shape, dtype=np.int64))
    if dtype in FLOATS and step is None:
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(cursor.take(rows * width * size), np.uint8).reshape(size, rows * width)
        return np.frombuffer(planes.T.tobytes(), dtype).reshape(rows, *shape)
    table = unpacked(cursor, rows, width)
    if step is not None:
        return (table * step).astype(dtype).reshape(rows, *shape)
    if rows and width and (table.astype(dtype) != table).any():
        raise ValueError(f"a number is no {dtype}: it is damaged")
    return table.astype(dtype).reshape(rows, *shape)
