"""Points on a grid, in the order of a space-filling curve: neighbors in space follow each other.

The order of rows means nothing, so it is free to choose. Along Morton's curve (bits of x, y and z in turn) only the
distance from a point to the next one is stored: with n points in a box this saves log2(n!) bits in all.
"""

import struct

import numpy as np
from jaxtyping import Float64, Int64, UInt64

from sparsestreet.codec.integers import packed, unpacked
from sparsestreet.codec.reading import Cursor

BITS = 21
"""Of a coordinate: three fit 63 bits."""

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that move the bits of a number three apart, half of them at a time."""


def curve_order(points: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Returns the rows along Morton's curve through the box of all points."""
    if not len(points):
        return np.zeros(0, np.int64)
    low = points.min(0)
    cell = max(float((points.max(0) - low).max()) / (2**BITS - 1), np.finfo(np.float64).tiny)
    return np.argsort(_codes(((points - low) / cell).astype(np.int64)), kind="stable")


def fits(points: Float64[np.ndarray, "n 3"], step: float) -> bool:
    """Whether the points' box is small enough for a grid of this step, meters."""
    return not len(points) or float((points.max(0) - points.min(0)).max()) / step < 2**BITS - 1


def packed_points(points: Float64[np.ndarray, "n 3"], step: float) -> tuple[Int64[np.ndarray, " n"], list[bytes]]:
    """Returns the order in which points are stored, and their bytes; each coordinate is off by half a step at most.

    ``points`` must fit (``fits``).
    """
    low = points.min(0) if len(points) else np.zeros(3)
    codes = _codes(np.rint((points - low) / step).astype(np.int64))
    order = np.argsort(codes, kind="stable")
    steps = np.diff(codes[order].astype(np.int64), prepend=0)
    return order, [struct.pack("<4d", step, *low), *packed(steps[:, None])]


def unpacked_points(cursor: Cursor, rows: int) -> Float64[np.ndarray, "n 3"]:
    """Returns the points from where their bytes begin, in the stored order."""
    step, *low = cursor.numbers("<4d")
    codes = np.cumsum(unpacked(cursor, rows, 1)[:, 0]).astype(np.uint64)
    return np.array(low) + step * _grid(codes)


def _codes(grid: Int64[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    codes = np.zeros(len(grid), np.uint64)
    for axis in range(3):
        bits = grid[:, axis].astype(np.uint64)
        for shift, mask in _SPREAD:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        codes |= bits << np.uint64(axis)
    return codes


def _grid(codes: UInt64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 3"]:
    grid = np.empty((len(codes), 3), np.int64)
    for axis in range(3):
        bits = (codes >> np.uint64(axis)) & np.uint64(_SPREAD[-1][1])
        for (shift, _), mask in zip(_SPREAD[::-1], [*(mask for _, mask in _SPREAD[-2::-1]), 2**BITS - 1], strict=True):
            bits = (bits | (bits >> np.uint64(shift))) & np.uint64(mask)
        grid[:, axis] = bits.astype(np.int64)
    return grid
