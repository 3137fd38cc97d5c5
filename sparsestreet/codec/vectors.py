"""Positions, rotations and harmonics as integers."""

import itertools
import struct

import numpy as np
from jaxtyping import Float64, Int16, Int64, UInt64
from scipy.spatial.transform import Rotation

from sparsestreet.codec.arrays import Cursor, packed, unpacked

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
    """Return the rows along Morton's curve through the box of all points."""
    if not len(points):
        return np.zeros(0, np.int64)
    low = points.min(0)
    cell = max(float((points.max(0) - low).max()) / (2**BITS - 1), np.finfo(np.float64).tiny)
    return np.argsort(_codes(((points - low) / cell).astype(np.int64)), kind="stable")


def fits(points: Float64[np.ndarray, "n 3"], step: float) -> bool:
    """Whether the points' box is small enough for a grid of this step, meters."""
    return not len(points) or float((points.max(0) - points.min(0)).max()) / step < 2**BITS - 1


def packed_points(points: Float64[np.ndarray, "n 3"], step: float) -> tuple[Int64[np.ndarray, " n"], list[bytes]]:
    """Return the order in which points are stored, and their bytes; each coordinate is off by half a step at most.

    ``points`` must fit (``fits``).
    """
    low = points.min(0) if len(points) else np.zeros(3)
    codes = _codes(np.rint((points - low) / step).astype(np.int64))
    order = np.argsort(codes, kind="stable")
    steps = np.diff(codes[order].astype(np.int64), prepend=0)
    return order, [struct.pack("<4d", step, *low), *packed(steps[:, None])]


def unpacked_points(cursor: Cursor, rows: int) -> Float64[np.ndarray, "n 3"]:
    """Return the points from where their bytes begin, in the stored order."""
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


_BLOCK = 8192
"""Rows whose 24 rotations are in memory at the same time."""


def _cube_rotations() -> Float64[np.ndarray, "24 4"]:
    """Return the rotations of a cube as unit quaternions, wxyz, one of each pair q and -q."""
    found = []
    for numbers in itertools.product((-1, 0, 1), repeat=4):
        length = sum(abs(number) for number in numbers)
        if length in (1, 2, 4) and next(number for number in numbers if number) > 0:
            found.append(np.array(numbers) / np.sqrt(length))
    return np.array(found)


_CUBE = _cube_rotations()
_ORDERS = np.abs(Rotation.from_quat(_CUBE, scalar_first=True).as_matrix()).argmax(1)
"""Which old axis each new axis lies along, for each rotation of a cube."""


def nearest_turn(
    quaternions: Float64[np.ndarray, "n 4"],
) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "n 3"]]:
    """Return Rodrigues vectors, and for each row the order of axes that its scales must be put in.

    Quaternions are wxyz, of any length; one of no length turns nothing.

    >>> half = np.sqrt(0.5)  # a quarter turn about z exchanges x and y
    >>> vector, order = nearest_turn(np.array([[half, 0, 0, half]]))
    >>> np.abs(vector).max().round(9).tolist(), order.tolist()
    (0.0, [[1, 0, 2]])
    """
    vectors, orders = np.empty((len(quaternions), 3)), np.empty((len(quaternions), 3), np.int64)
    for start in range(0, len(quaternions), _BLOCK):
        block = slice(start, start + _BLOCK)
        turned = _products(quaternions[block])
        best = np.abs(turned[:, :, 0]).argmax(1)
        chosen = turned[np.arange(len(turned)), best]
        none = chosen[:, :1] == 0  # of a quaternion of no length
        vectors[block] = chosen[:, 1:] / np.where(none, 1, chosen[:, :1])
        orders[block] = _ORDERS[best]
    return vectors, orders


def quaternions_of(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """Return unit quaternions, wxyz.

    >>> quaternions_of(np.zeros((1, 3))).tolist()
    [[1.0, 0.0, 0.0, 0.0]]
    """
    full = np.concatenate([np.ones((len(vectors), 1)), vectors], axis=1)
    return full / np.linalg.norm(full, axis=1, keepdims=True)


def _products(quaternions: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 24 4"]:
    """Return each quaternion times each rotation of the cube."""
    aw, ax, ay, az = (part[:, None] for part in quaternions.T)
    bw, bx, by, bz = _CUBE.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


_UNIT = 2**15 - 1


def principal_axes(second_moments: Float64[np.ndarray, "d d"]) -> Int16[np.ndarray, "d d"]:
    """Return a column for each axis, the one of most energy first, in units of 1 / 32767."""
    _, axes = np.linalg.eigh(second_moments)
    return np.rint(axes[:, ::-1] * _UNIT).astype(np.int16)


def along_axes(values: Float64[np.ndarray, "n d"], axes: Int16[np.ndarray, "d d"]) -> Float64[np.ndarray, "n d"]:
    """Return the values in axes that are rounded, and so not quite orthogonal: ``from_axes`` gives them back."""
    return np.linalg.solve(axes / _UNIT, values.T).T


def from_axes(values: Float64[np.ndarray, "n d"], axes: Int16[np.ndarray, "d d"]) -> Float64[np.ndarray, "n d"]:
    """Return what ``along_axes`` was given."""
    return values @ (axes / _UNIT).T


def packed_axes(axes: Int16[np.ndarray, "d d"]) -> bytes:
    """Return the bytes of the axes."""
    return axes.astype("<i2").tobytes()


def unpacked_axes(cursor: Cursor, size: int) -> Int16[np.ndarray, "d d"]:
    """Return the axes from where their bytes begin."""
    return np.frombuffer(cursor.take(2 * size * size), "<i2").reshape(size, size).astype(np.int16)
