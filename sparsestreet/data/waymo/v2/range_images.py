"""Range images from the cells of a table, packed small while they wait."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from sparsestreet.data.problems import fault
from sparsestreet.data.waymo.lidar import returns_of
from sparsestreet.data.waymo.segment import REMEDY, Returns

_LARGEST = 2**24
"""Numbers of an image: TOP's poses are a million."""


def image(values: Any, shape: Any, channels: int, path: Path) -> np.ndarray | None:
    """rows x columns x channels float32 of two Arrow cells; None where they are empty."""
    if not values.is_valid or not shape.is_valid or not len(values.values):
        return None
    sides = shape.as_py()
    flat = values.values.to_numpy(zero_copy_only=False)
    if (
        len(sides) != 3
        or sides[2] != channels
        or min(sides) <= 0
        or math.prod(sides) != len(flat)
        or len(flat) > _LARGEST
        or flat.dtype.kind != "f"
    ):
        message = f"a range image has {len(flat)} numbers for the shape {sides}, which needs {channels} channels"
        raise fault(path, message, REMEDY)
    return flat.astype(np.float32).reshape(sides)


def pack_returns(cells: list[Any], path: Path) -> bytes:
    """Rows, columns and number of returns, then pixels and ranges: a range image is mostly empty channels."""
    pairs = zip(cells[::2], cells[1::2], strict=True)
    images = [found for found in (image(values, shape, 4, path) for values, shape in pairs) if found is not None]
    if not images:
        return b""
    returns = returns_of("", images, None)
    head = np.array([*returns.shape, len(returns.pixels)], "<i8")
    return head.tobytes() + returns.pixels.astype("<i4").tobytes() + returns.ranges.astype("<f4").tobytes()


def pack_poses(cells: list[Any], path: Path) -> bytes:
    values, shape = cells
    found = image(values, shape, 6, path)
    if found is None:
        raise fault(path, "a row of the lidar TOP has no poses", REMEDY)
    return np.array(found.shape[:2], "<i8").tobytes() + found.astype("<f4").tobytes()


def unpack(lidar: str, packed: bytes, poses: bytes | None) -> Returns:
    """The returns, with the poses of the pixels."""
    if not packed:
        return Returns(lidar, (1, 1), np.zeros(0, np.int64), np.zeros(0, np.float32))
    height, width, count = np.frombuffer(packed, "<i8", 3).tolist()
    pixels = np.frombuffer(packed, "<i4", count, 24).astype(np.int64)
    ranges = np.frombuffer(packed, "<f4", count, 24 + 4 * count)
    matrix = None
    if poses is not None:
        rows, columns = np.frombuffer(poses, "<i8", 2).tolist()
        matrix = np.frombuffer(poses, "<f4", offset=16).reshape(rows, columns, 6)
    return Returns(lidar, (height, width), pixels, ranges, matrix)
