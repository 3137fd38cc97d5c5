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
from sparsestreet.data.poses import rigid_poses
from sparsestreet.data.problems import fault
from sparsestreet.data.reader import listed
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, transform_points

FRONT = "front_camera"
"""Its instants are the middles of the sweeps."""
USUAL_CAMERAS = (FRONT, "front_left_camera", "front_right_camera")
EGO_ROWS = {"back_camera": (260, 1080)}
"""How many of the lowest rows show the recording car, and of how many (NeuRAD crops these)."""
CAMERA_FROM_LIDAR = torch.eye(4, dtype=torch.float64)
"""Front camera (OpenCV's axes) from the spinning lidar (x left, y backward, z up): the static calibration of the
devkit, docs/static_extrinsic_calibration.yaml. The file lidar/poses.json holds another frame, and is not read."""
CAMERA_FROM_LIDAR[:3, :3] = quat.to_matrix(
    torch.tensor(
        [0.016213200031258722, 0.0030578899383849464, 0.7114721800418571, -0.7025205466606356], dtype=torch.float64
    )
)
CAMERA_FROM_LIDAR[:3, 3] = torch.tensor([0.0002585796504896516, -0.03907777167811011, -0.0440125762408362])
OWN_CAR = (1.0, 2.0, 2.0)
"""Meters along the axes of the lidar. Returns nearer in all three are of the recording car (NeuRAD)."""
_MARK = f"camera/{FRONT}/poses.json"
_FOLDERS = (".", "*", "*/*")
"""Of a sequence, below the root."""


@dataclass(frozen=True)
class Layout:
    """The files of one sequence."""

    root: Path

    def camera(self, name: str) -> Path:
        return self.root / "camera" / name

    def image(self, name: str, frame: int) -> Path:
        return self.camera(name) / f"{frame:02d}.jpg"

    @property
    def lidar(self) -> Path:
        return self.root / "lidar"

    def sweep(self, frame: int) -> Path:
        return _packed(self.lidar, frame)

    @property
    def cuboids(self) -> Path:
        return self.root / "annotations" / "cuboids"

    def boxes(self, frame: int) -> Path:
        return _packed(self.cuboids, frame)

    @property
    def cameras(self) -> list[str]:
        return sorted(path.name for path in (self.root / "camera").iterdir() if path.is_dir() and path.name[0] != ".")


def find_sequence(root: Path, scene: str | int | None) -> Layout:
    """The sequence of a name, such as "001" (or 1), at the root or at most two folders below.

    Raises ValueError where there is none, or more than one.
    """
    name = f"{scene:03d}" if isinstance(scene, int) else scene
    length = len(Path(_MARK).parts)
    found = sorted({path.parents[length - 1] for folder in _FOLDERS for path in root.glob(f"{folder}/{_MARK}")})
    if not found:
        raise ValueError(f"no sequence of PandaSet is in {root}: a sequence's folder holds {_MARK}")
    fitting = [one for one in found if name is None or one.resolve().name == name]
    if len(fitting) == 1:
        return Layout(fitting[0])
    names = listed([one.name for one in fitting or found])
    which = f"{len(fitting)} of {len(found)} sequences are" if name else f"there are {len(found)} sequences"
    raise ValueError(f"{which}{f' {name}' if name else ''} in {root}: say data.log.scene=, one of {names}")


def _packed(folder: Path, frame: int) -> Path:
    """The file of an instant: as published, or without compression, as a copy of the data set has it."""
    packed = folder / f"{frame:02d}.pkl.gz"
    plain = folder / f"{frame:02d}.pkl"
    return plain if plain.is_file() and not packed.is_file() else packed


PER_SECOND = 1_000_000_000
_MAX_JSON = 16_000_000
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
    if path.stat().st_size > _MAX_JSON:
        raise fault(path, f"it has {path.stat().st_size} bytes, as no file of its kind has", _REMEDY)
    try:
        check_regular(path)
        return json.loads(path.read_text(), parse_float=parse_float)
    except (OSError, ValueError, RecursionError, ArithmeticError) as error:
        raise fault(path, f"it is no JSON ({type(error).__name__}: {error})"[:300], _REMEDY) from error
