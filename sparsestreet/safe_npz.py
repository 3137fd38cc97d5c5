"""Reads NumPy's archives (``.npz``) that others wrote, in memory that is bounded before anything is read."""

import math
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from sparsestreet.atomic import check_regular

LARGEST = 1 << 30
"""Bytes of all arrays beyond the size of the file: what is compressed may grow so much."""


def read_npz(path: Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of these names; None: all.

    Sizes are those of the archive's list and of each array's header, and must agree before memory is taken.

    Raises ValueError, saying what is wrong, for a file that is damaged, holds something else than numbers and text, or
    would grow without bound; KeyError where an array is missing.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "points.npz")
    ...     np.savez(path, count=np.arange(3))
    ...     read_npz(path)
    {'count': array([0, 1, 2])}
    """
    try:
        check_regular(path)
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            chosen = list(sizes) if names is None else list(names)
            if missing := [name for name in chosen if name not in sizes]:
                raise KeyError(f"it has no {missing[0]}")
            total = sum(sizes[name].file_size for name in chosen)
            if total > LARGEST + path.stat().st_size:
                raise ValueError(f"its arrays would take {total:,} bytes")
            return {name: _array(archive, sizes[name]) for name in chosen}
    except (KeyError, MemoryError):
        raise
    except Exception as error:  # each part of a broken archive fails in its own way
        raise ValueError(f"it is no archive of arrays: {type(error).__name__}: {error}"[:300]) from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    with archive.open(entry) as file:
        shape, by_columns, kind = headers[npy.read_magic(file)](file)
        if kind.hasobject:
            raise ValueError("it holds objects, whose pickle may run code")
        left, wanted = entry.file_size - file.tell(), math.prod(shape) * kind.itemsize
        if left != wanted:
            raise ValueError(f"an array of shape {shape} of {kind} has {left:,} bytes")
        values = np.frombuffer(bytearray(file.read()), kind)
    return values.reshape(shape, order="F" if by_columns else "C")
