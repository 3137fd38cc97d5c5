"""Sparse models in text: an entry a line, numbers separated by spaces, comments behind a #."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sparsestreet.atomic import check_regular
from sparsestreet.data.colmap.lenses import MODELS
from sparsestreet.data.colmap.rows import CameraRow, ImageRow
from sparsestreet.data.problems import LogError, fault

_REMEDY = "export the model again"
_LONGEST_NAME = 60
"""Words."""
_LONGEST_LINE = 32_000_000
"""Bytes: an image's line holds all of its observations."""
_MODELS = {model.name: model for model in MODELS}


def camera_rows(path: Path) -> Iterator[CameraRow]:
    for number, line in _entries(path):
        words = line.split()
        model = _MODELS.get(words[1]) if len(words) > 1 else None
        if model is None:
            name = words[1][:40] if len(words) > 1 else ""
            raise _broken(path, number, f"its model is {name!r}, of which nothing is known")
        if len(words) != 4 + len(model.numbers):
            raise _broken(path, number, f"a {model.name} has {len(model.numbers)} numbers, not {len(words) - 4}")
        try:
            size = int(words[2]), int(words[3])
            yield CameraRow(int(words[0]), model, size, tuple(map(float, words[4:])))
        except ValueError as error:
            raise _broken(path, number, f"it is no camera ({error})") from error


def image_rows(path: Path) -> Iterator[ImageRow]:
    """Two lines an image; the second, of observations, may be empty and is passed over. Files that are written by hand
    leave these lines out, so what cannot be one is the next image."""
    number, waiting, observed = 0, False, False
    for number, line in _lines(path):
        if line.startswith("#"):
            continue
        if waiting and (not line.strip() or _observes(line)):
            waiting, observed = False, True
            continue
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            if len(words) != 10:
                raise ValueError("10 words are wanted")
            pose = tuple(map(float, words[1:8]))
            yield ImageRow(int(words[0]), words[9].strip(), int(words[8]), pose)
        except ValueError as error:
            raise _broken(path, number, f"it is no image ({error})") from error
        waiting = True
    if waiting and observed:
        raise _broken(path, number, "no line of observations follows it, which may be empty")


def _observes(line: str) -> bool:
    """Whether these are triples of numbers; of a long line the last word tells, because no name is as long."""
    words = line.split(maxsplit=_LONGEST_NAME)
    if len(words) > _LONGEST_NAME:
        words = [line.rsplit(maxsplit=1)[-1]] * 3
    try:
        return len(words) % 3 == 0 and all(float(word) < math.inf for word in words)
    except ValueError:
        return False


def points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions n x 3 in float64 and RGB n x 3 in uint8."""
    positions: list[tuple[float, ...]] = []
    colors: list[tuple[int, ...]] = []
    for number, line in _entries(path):
        words = line.split(maxsplit=7)
        try:
            position, color = tuple(map(float, words[1:4])), tuple(map(int, words[4:7]))
        except ValueError as error:
            raise _broken(path, number, f"it is no point ({error})") from error
        if len(color) != 3 or not all(0 <= value <= 255 for value in color):
            raise _broken(path, number, "it is no point of three lengths and three colors from 0 to 255")
        positions.append(position)
        colors.append(color)
    return np.array(positions, np.float64).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3)


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    return ((number, line) for number, line in _lines(path) if line.strip() and not line.startswith("#"))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and their numbers, counted from 1."""
    try:
        check_regular(path)
        with path.open(encoding="utf-8") as file:
            number = 0
            while line := file.readline(_LONGEST_LINE):
                number += 1
                if len(line) == _LONGEST_LINE:
                    raise _broken(path, number, f"it has more than {_LONGEST_LINE:,} letters")
                yield number, line
    except UnicodeDecodeError as error:
        raise fault(path, f"the file is no text ({error})", _REMEDY) from error


def _broken(path: Path, line: int, message: str) -> LogError:
    return fault(path, f"line {line}: {message}", _REMEDY)
