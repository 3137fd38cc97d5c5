"""Reads YAML and NumPy's archives that others wrote, within stated limits of size."""

import math
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np
import yaml
from numpy.lib import format as npy

from sparsestreet.atomic import check_regular

Value = TypeVar("Value")

MAX_YAML = 2_000_000
"""Bytes of a file: PyYAML takes ten seconds for as many."""
MAX_GROWTH = 1 << 30
"""Bytes of all arrays beyond the size of the file: what is compressed may grow so much."""


def read_yaml(path: Path, parse: Callable[[str], Value]) -> Value:
    """Return what a parser of PyYAML's makes of a file.

    An alias stands for a part of the file as often as it is named: ten lines of them make a value of 10^10 entries,
    once somebody copies or prints it. So none may be in the file.

    Raises FileNotFoundError, or ValueError, naming the file, for what is no YAML, holds aliases or is too large.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "edits.yaml")
    ...     _ = path.write_text("remove: [car_3]")
    ...     read_yaml(path, yaml.safe_load)
    {'remove': ['car_3']}
    """
    check_regular(path)
    if (size := path.stat().st_size) > MAX_YAML:
        raise ValueError(f"{path} has {size:,} bytes, more than the {MAX_YAML:,} that are read: shorten it")
    try:
        text = path.read_text(encoding="utf-8")
        aliases = "*" in text and any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text, yaml.SafeLoader))
        if not aliases:
            return parse(text)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no YAML: it is no text ({error})") from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a number of more digits than Python reads
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise ValueError(f"{path} is no YAML that can be read: brackets in brackets without end") from error
    raise ValueError(f"{path} holds aliases (*name), which are not read: write out what they stand for")


def read_npz(path: Path, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of these names; None: all.

    Raises ValueError, saying what is wrong, for a file that is damaged, holds something else than numbers and text, or
    would grow by more than MAX_GROWTH; KeyError where an array is missing.

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
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            chosen = list(entries) if names is None else list(names)
            if missing := [name for name in chosen if name not in entries]:
                raise KeyError(f"it has no {missing[0]}")
            total = sum(entries[name].file_size for name in chosen)
            if total > MAX_GROWTH + path.stat().st_size:
                raise ValueError(f"its arrays would take {total:,} bytes")
            return {name: _array(archive, entries[name]) for name in chosen}
    except (KeyError, MemoryError):
        raise
    except Exception as error:  # each part of a broken archive fails in its own way
        raise ValueError(f"it is no archive of arrays: {type(error).__name__}: {error}"[:300]) from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """Read an array, whose header must agree with the archive's list before memory is taken."""
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    with archive.open(entry) as file:
        shape, _, kind = headers[npy.read_magic(file)](file)
        wanted = math.prod(shape) * kind.itemsize
        if not kind.hasobject and entry.file_size - file.tell() != wanted:
            raise ValueError(f"an array of shape {shape} of {kind} has {entry.file_size - file.tell():,} bytes")
    with archive.open(entry) as file:
        return npy.read_array(file, allow_pickle=False)
