"""Tables of integers as bytes that zstd packs well: column by column, the low bytes of all rows, then the next ones."""

import numpy as np
from jaxtyping import Integer

from sparsestreet.codec.reading import Cursor

_SIGN = np.uint64(1)
_DIFFERENCES = 0x80
"""Set in a column's first byte where it holds each value's difference from the one before."""


def packed(table: Integer[np.ndarray, "n c"]) -> list[bytes]:
    """Returns the bytes of a table of int64 values, a piece a column; their concatenation is what is read.

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
    """Returns the table from where its bytes begin. Raises ValueError where they are not such a table's."""
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
    """Returns about how many bits entropy coding of single bytes would need."""
    folded = _folded(column)
    low, high = folded & np.uint64(0xFF), (folded >> np.uint64(8)) & np.uint64(0xFF)
    return sum(_entropy(part) for part in (low, high)) + 16.0 * float((folded >> np.uint64(16) > 0).sum())


def _entropy(values: Integer[np.ndarray, " n"]) -> float:
    counts = np.bincount(values.astype(np.int64))
    counts = counts[counts > 0]
    return float((counts * np.log2(counts.sum() / counts)).sum())
