"""Sparse models in binary: little-endian numbers, one entry behind the other.

No memory is taken that the file's own size does not justify; observations are skipped, not read.
"""

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sparsestreet.atomic import check_regular
from sparsestreet.data.colmap.lenses import MODELS
from sparsestreet.data.colmap.rows import CameraRow, ImageRow
from sparsestreet.data.problems import fault

_REMEDY = "copy or export the model again"
_LONGEST_NAME = 4096
_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_COUNT = struct.Struct("<Q")
_OBSERVATION, _TRACK_ELEMENT = 24, 8
"""Bytes of an image's observation (x, y, point) and of a point's (image, place)."""


@dataclass
class _OpenFile:
    """A file and how much of it is left."""

    file: BinaryIO
    path: Path
    left: int

    def take(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack(self.bytes(layout.size, what))

    def bytes(self, count: int, what: str) -> bytes:
        self._claim(count, what)
        return self.file.read(count)

    def skip(self, count: int, what: str) -> None:
        self._claim(count, what)
        self.file.seek(count, os.SEEK_CUR)

    def name(self, what: str) -> str:
        """Up to a zero."""
        letters = bytearray()
        while (letter := self.bytes(1, what)) != b"\0":
            letters += letter
            if len(letters) > _LONGEST_NAME:
                raise fault(self.path, f"{what} has a name of more than {_LONGEST_NAME} bytes", _REMEDY)
        try:
            return letters.decode()
        except UnicodeDecodeError as error:
            raise fault(self.path, f"{what} has a name that is no text", _REMEDY) from error

    def count(self, least: int, what: str) -> int:
        """Of entries that take at least so many bytes each."""
        (count,) = self.take(_COUNT, what)
        if count * least > self.left:
            message = f"it announces {count:,} {what}, but {self.left:,} bytes follow"
            raise fault(self.path, message, _REMEDY)
        return count

    def end(self) -> None:
        if self.left:
            raise fault(self.path, f"{self.left:,} bytes follow its last entry", _REMEDY)

    def _claim(self, count: int, what: str) -> None:
        if count > self.left:
            raise fault(self.path, f"the file ends within {what}", _REMEDY)
        self.left -= count


def camera_rows(path: Path) -> Iterator[CameraRow]:
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        for _ in range(table.count(_CAMERA.size, "cameras")):
            number, model, width, height = table.take(_CAMERA, "a camera")
            if not 0 <= model < len(MODELS):
                message = f"camera {number} has model {model}, of which nothing is known"
                raise fault(path, message, "run COLMAP's image_undistorter, and read its images and model")
            layout = struct.Struct(f"<{len(MODELS[model].numbers)}d")
            yield CameraRow(number, MODELS[model], (width, height), table.take(layout, f"camera {number}"))
        table.end()


def image_rows(path: Path) -> Iterator[ImageRow]:
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        for _ in range(table.count(_IMAGE.size + 1 + _COUNT.size, "images")):
            number, *pose, camera = table.take(_IMAGE, "an image")
            what = f"image {number}"
            name = table.name(what)
            table.skip(_OBSERVATION * table.count(_OBSERVATION, f"observations of {what}"), what)
            yield ImageRow(number, name, camera, tuple(pose))
        table.end()


def points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions n x 3 in float64 and RGB n x 3 in uint8."""
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        count = table.count(_POINT.size, "points")
        positions, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        for row in range(count):
            _, *values, _, length = table.take(_POINT, f"point {row}")
            positions[row], colors[row] = values[:3], values[3:]
            table.skip(_TRACK_ELEMENT * length, f"point {row}")
        table.end()
    return positions, colors
