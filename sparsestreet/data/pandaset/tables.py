"""Poses and stamps of the cameras, the points of a sweep, the cuboids of an instant."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.lidar import check_points
from sparsestreet.data.pandaset.frames import read_columns
from sparsestreet.data.pandaset.layout import OWN_CAR
from sparsestreet.data.poses import rigid_poses
from sparsestreet.data.problems import fault
from sparsestreet.geometry.cameras import inverse, transform_points

PER_SECOND = 1_000_000_000
_LARGEST_JSON = 16_000_000
"""Bytes. Poses of a sequence take 17 kB."""
_LATEST = 2**63 // PER_SECOND
_REMEDY = "fetch the file again"
_CUBOIDS = {"uuid": str, "label": str, "yaw": float, "stationary": bool, "cuboids.sibling_id": str}
_NUMBERS = ("position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z")
_FRONT_LIDAR = 1
"""sensor_id of cuboids that were drawn around returns of the lidar that looks ahead."""


@dataclass(frozen=True)
class Returns:
    """The returns of an instant, without those of the recording car."""

    world: Float64[Tensor, "n 3"]
    local: Float64[Tensor, "n 3"]
    """In the frame of the spinning lidar at the stamp of the sweep."""
    seconds: np.ndarray
    """n, absolute, when each was measured."""
    spinning: np.ndarray
    """n, whether each is of the spinning lidar."""


@dataclass(frozen=True)
class Cuboids:
    """The boxes of an instant, each object once."""

    names: list[str]
    labels: list[str]
    poses: np.ndarray
    """n x 4 x 4 world_from_object: x along the length, y left, z up, from the center."""
    sizes: np.ndarray
    """n x 3 length, width, height."""
    stationary: np.ndarray
    spinning: np.ndarray
    """n, whether each may be drawn around returns of the spinning lidar."""
    twins: int
    """How many were left out, because the other lidar saw the object too."""


def read_stamps(path: Path) -> list[int]:
    """Decimal seconds in nanoseconds; raises LogError for numbers that no clock shows, or that do not increase."""
    seconds = _json(path, parse_float=Decimal)
    if not isinstance(seconds, list) or not seconds:
        raise fault(path, "it is no list of seconds", _REMEDY)
    stamps = []
    for place, second in enumerate(seconds):
        number = Decimal(second) if type(second) is int else second
        if not isinstance(number, Decimal) or not number.is_finite() or number.copy_abs() > _LATEST:
            raise fault(path, f"stamp {place} is no number of seconds that a clock can show", _REMEDY)
        stamps.append(int((number * PER_SECOND).to_integral_value()))
        if place and stamps[-1] <= stamps[-2]:
            raise fault(path, f"stamps must increase, but {place} lies before {place - 1}", _REMEDY)
    return stamps


def read_poses(path: Path) -> Float64[Tensor, "n 4 4"]:
    """world_from_sensor of each frame; raises LogError."""
    entries = _json(path)
    try:
        positions = [[entry["position"][axis] for axis in "xyz"] for entry in entries]
        headings = [[entry["heading"][axis] for axis in "wxyz"] for entry in entries]
        numbers = np.array(headings, dtype=np.float64).reshape(-1, 4), np.array(positions, np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError, OverflowError, IndexError) as error:
        message = f"it is no list of position x y z and heading w x y z ({type(error).__name__}: {error})"[:300]
        raise fault(path, message, _REMEDY) from error
    return rigid_poses(torch.from_numpy(numbers[0]), torch.from_numpy(numbers[1]), path, "frame")


def read_intrinsics(path: Path) -> Float64[Tensor, "3 3"]:
    """Pixels; raises LogError. Where pixel centers lie is not documented: the numbers are taken as they are."""
    entry = _json(path)
    found = [entry.get(name) for name in ("fx", "fy", "cx", "cy")] if isinstance(entry, dict) else []
    numbers = [float(number) for number in found if isinstance(number, int | float) and 0 < number < 1e6]
    if len(numbers) < 4:
        raise fault(path, f"fx, fy, cx, cy must be positive pixels, they are {str(found)[:100]}", _REMEDY)
    fx, fy, cx, cy = numbers
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def read_returns(path: Path, world_from_lidar: Float64[Tensor, "4 4"]) -> Returns:
    """The points of both lidars, which the file holds in the world; raises LogError."""
    table = read_columns(path, dict.fromkeys(("x", "y", "z", "t"), float) | {"d": int})
    world = torch.from_numpy(np.stack([table[axis] for axis in "xyz"], -1))
    local = transform_points(inverse(world_from_lidar), world)
    check_points(local, path)
    kept = (local.abs() >= torch.tensor(OWN_CAR)).any(-1)
    rows = kept.numpy()
    return Returns(world[kept], local[kept], table["t"][rows], table["d"][rows] == 0)


def read_cuboids(path: Path) -> Cuboids:
    """The boxes of a file, of twins only that of the spinning lidar; raises LogError.

    An object that both lidars see has a box for each; each names the other as its sibling.
    """
    kinds = _CUBOIDS | dict.fromkeys(_NUMBERS, float) | {"cuboids.sensor_id": int}
    table = read_columns(path, kinds)
    front = table["cuboids.sensor_id"] == _FRONT_LIDAR
    kept: dict[str, int] = {}
    for row in np.argsort(front, kind="stable").tolist():
        name, sibling = str(table["uuid"][row]), table["cuboids.sibling_id"][row]
        if name in kept:
            raise fault(path, f"object {name} has two boxes", "keep one box of an object at an instant")
        if not sibling or sibling not in kept:
            kept[name] = row
    rows = sorted(kept.values())
    centers, sizes = (np.stack([table[f"{what}.{axis}"][rows] for axis in "xyz"], -1) for what in _SHAPES)
    # A heading of 0 points along y, and the length lies along it; ours points along x.
    half = (table["yaw"][rows] + np.pi / 2) / 2
    quaternions = np.stack((np.cos(half), 0 * half, 0 * half, np.sin(half)), -1)
    poses = rigid_poses(torch.from_numpy(quaternions), torch.from_numpy(centers), path, "box")
    return Cuboids(
        names=[str(table["uuid"][row]) for row in rows],
        labels=[str(table["label"][row]) for row in rows],
        poses=poses.numpy(),
        sizes=sizes[:, [1, 0, 2]],
        stationary=table["stationary"][rows],
        spinning=~front[rows],
        twins=len(front) - len(rows),
    )


_SHAPES = ("position", "dimensions")


def _json(path: Path, parse_float: Callable[[str], Any] = float) -> Any:
    if not path.is_file():
        raise fault(path, "the file is missing", _REMEDY)
    if path.stat().st_size > _LARGEST_JSON:
        raise fault(path, f"it has {path.stat().st_size} bytes, as no file of its kind has", _REMEDY)
    try:
        check_regular(path)
        return json.loads(path.read_text(), parse_float=parse_float)
    except (OSError, ValueError, RecursionError, ArithmeticError) as error:
        raise fault(path, f"it is no JSON ({type(error).__name__}: {error})"[:300], _REMEDY) from error
