"""Spherical harmonics by energy: the directions in which colors of a scene vary most come first.

The harmonics of all rows lie near few directions (brightness above all). In their principal axes (Karhunen-Loeve) most
numbers are near 0 and cost next to nothing, though all have the same step. As the axes are orthogonal, so is the error.
"""

import numpy as np
from jaxtyping import Float64, Int16

from sparsestreet.codec.reading import Cursor

_UNIT = 2**15 - 1


def principal_axes(second_moments: Float64[np.ndarray, "d d"]) -> Int16[np.ndarray, "d d"]:
    """Returns a column for each axis, the one of most energy first, in units of 1 / 32767."""
    _, axes = np.linalg.eigh(second_moments)
    return np.rint(axes[:, ::-1] * _UNIT).astype(np.int16)


def along_axes(values: Float64[np.ndarray, "n d"], axes: Int16[np.ndarray, "d d"]) -> Float64[np.ndarray, "n d"]:
    """Returns the values in axes that are rounded, and so not quite orthogonal: ``from_axes`` gives them back."""
    return np.linalg.solve(axes / _UNIT, values.T).T


def from_axes(values: Float64[np.ndarray, "n d"], axes: Int16[np.ndarray, "d d"]) -> Float64[np.ndarray, "n d"]:
    """Returns what ``along_axes`` was given."""
    return values @ (axes / _UNIT).T


def packed_axes(axes: Int16[np.ndarray, "d d"]) -> bytes:
    """Returns the bytes of the axes."""
    return axes.astype("<i2").tobytes()


def unpacked_axes(cursor: Cursor, size: int) -> Int16[np.ndarray, "d d"]:
    """Returns the axes from where their bytes begin."""
    return np.frombuffer(cursor.take(2 * size * size), "<i2").reshape(size, size).astype(np.int16)
