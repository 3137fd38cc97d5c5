"""Text files of KITTI: numbers by key, and stamps by line. Sizes are checked before anything is read."""

import calendar
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import fault

_LARGEST = 1 << 26
"""Bytes; the longest sequence of KITTI-360 has stamps and poses of 3 MB."""
_STAMP = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?")
_REMEDY = "copy it again from the published archive"


def read_lines(path: Path, largest: int = _LARGEST) -> list[str]:
    """Stripped lines, empty ones among them; raises LogError where the file is missing, too large or no text."""
    try:
        if path.stat().st_size > largest:
            message = f"the file has {path.stat().st_size} bytes, more than the {largest} that such a file can have"
            raise fault(path, message, _REMEDY)
        check_regular(path)
        return [line.strip() for line in path.read_text("utf-8").splitlines()]
    except FileNotFoundError as error:
        raise fault(path, "the file is missing", _REMEDY) from error
    except (OSError, UnicodeDecodeError) as error:
        raise fault(path, f"the file cannot be read ({error})", _REMEDY) from error


def numbers(words: Sequence[str], path: Path, what: str) -> Float64[np.ndarray, " n"]:
    """Finite numbers; raises LogError for anything else."""
    try:
        found = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError as error:
        raise fault(path, f"{what} holds what is no number ({error})", _REMEDY) from error
    if not np.isfinite(found).all():
        raise fault(path, f"{what} holds NaN or infinity", _REMEDY)
    return found


def read_keyed(path: Path) -> dict[str, str]:
    """Lines ``key: value``; raises as ``read_lines``."""
    lines = (line.partition(":") for line in read_lines(path))
    return {key.strip(): value.strip() for key, colon, value in lines if colon}


def keyed_numbers(table: Mapping[str, str], key: str, shape: tuple[int, ...], path: Path) -> Float64[np.ndarray, "..."]:
    """The numbers of a key; raises LogError where it is missing or holds another number of them."""
    if key not in table:
        raise fault(path, f"it has no line {key!r}", _REMEDY)
    found = numbers(table[key].split(), path, f"the line {key!r}")
    if found.size != np.prod(shape):
        message = f"the line {key!r} has {found.size} numbers, not the {np.prod(shape)} of a {shape} matrix"
        raise fault(path, message, _REMEDY)
    return found.reshape(shape)


def read_stamps(path: Path) -> list[int | None]:
    """Line k is the stamp of frame k, nanoseconds since 1970 by the local clock; None where the line is empty.

    Lines are empty where a file was lost (drive 2011_09_26_0009). Raises LogError for lines that are no stamps.
    """
    return [_nanoseconds(line, path, number) if line else None for number, line in enumerate(read_lines(path), 1)]


def _nanoseconds(line: str, path: Path, number: int) -> int:
    match = _STAMP.fullmatch(line)
    if match is None:
        raise fault(path, f"line {number} is {line[:40]!r}, no YYYY-MM-DD hh:mm:ss.fraction", _REMEDY)
    *parts, fraction = match.groups()
    year, month, day, hour, minute, second = map(int, parts)
    if not (1970 <= year < 2200 and 1 <= month <= 12 and 1 <= day <= calendar.monthrange(year, month)[1]):
        raise fault(path, f"line {number} has the date {line[:10]}, which no calendar has", _REMEDY)
    if hour > 23 or minute > 59 or second > 60:
        raise fault(path, f"line {number} has the time {line[11:19]}, which no clock shows", _REMEDY)
    seconds = calendar.timegm((year, month, day, hour, minute, second))
    return 1_000_000_000 * seconds + int((fraction or "0").ljust(9, "0"))
