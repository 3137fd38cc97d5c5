"""Camera paths from files: poses, keyframes of a smooth path, and nerfstudio's ``camera_path.json``."""

import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from sparsestreet.export.path import CameraPath, intrinsics
from sparsestreet.geometry.cameras import inverse, rigidity_error
from sparsestreet.types import Camera, View

KINDS = ("camera_path", "poses", "keyframes")
"""The key of a file's list, which says what it is. nerfstudio's files have keyframes of their own beside theirs."""
_KEYS = {"seconds", "world_from_camera", "intrinsics", "width", "height"}
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LARGEST, _FASTEST = 16384, 1000
_RIGID = 1e-3
"""What numbers of a file may lack to a rotation; it is then made one."""


@dataclass(frozen=True)
class PathFile:
    """A path, and the frames a second that its file asks for; None: it asks for none."""

    path: CameraPath
    fps: float | None
    note: str | None = None
    """What is in the file and has no effect."""


@dataclass(frozen=True)
class _Pose:
    seconds: float
    world_from_camera: Float64[np.ndarray, "4 4"]
    lens: tuple[float, float, float, float]
    """fx, fy, cx, cy, pixels."""
    width: int
    height: int

    def view(self, time_of: Callable[[float], float]) -> View:
        pose = inverse(torch.from_numpy(self.world_from_camera)).float()
        return View(Camera(pose, intrinsics(*self.lens), self.width, self.height), time_of(self.seconds))


def read_path(path: Path, like: View, seconds: float, fps: float) -> PathFile:
    """Read a path of one camera.

    ::

        {"poses": [{"seconds": 0, "world_from_camera": [[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}, ...]}

    ``poses`` are a picture each; a spline joins ``keyframes`` of the same form; ``camera_path`` is nerfstudio's.
    A pose, or the file for all, may have ``intrinsics`` [fx, fy, cx, cy], ``width`` and ``height``.

    Args:
        path: the file.
        like: the camera whose intrinsics and size poses without their own have, at the log's first instant.
        seconds: how long normalized time 0 to 1 is.
        fps: pictures a second of a smooth path.

    Raises FileNotFoundError where there is no file, ValueError, naming file and entry, for what is wrong in it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no path at {path}: give a .json of poses (sparsestreet render --help)")
    try:
        said = json.loads(path.read_text())
        kind = next((kind for kind in KINDS if isinstance(said, dict) and isinstance(said.get(kind), list)), None)
        if kind is None or not said[kind]:
            raise ValueError(f"a path has a list of one of {', '.join(KINDS)}, and something in it")

        def time_of(at: float) -> float:
            time = like.time + at / seconds
            if not -1e-6 <= time <= 1 + 1e-6:
                raise ValueError(f"the log lasts from 0 to {seconds * (1 - like.time):g} seconds, got a pose at {at:g}")
            return min(max(time, 0.0), 1.0)

        if kind == "camera_path":
            last = seconds * (1 - like.time)
            return _nerfstudio(said, last, time_of)
        poses = [_pose(entry, said, like, f"{kind}[{index}]") for index, entry in enumerate(said[kind])]
        if kind == "keyframes":
            poses = _splined(poses, fps)
        return PathFile(tuple((pose.view(time_of),) for pose in poses), None)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON: {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _pose(entry: Any, said: Mapping[str, Any], like: View, where: str) -> _Pose:
    if not isinstance(entry, dict) or entry.keys() - _KEYS:
        raise ValueError(f"{where} has the keys {', '.join(sorted(_KEYS))}, got {entry!r}")
    for key in ("seconds", "world_from_camera"):
        if key not in entry:
            raise ValueError(f"{where} lacks {key}")
    (fx, _, cx), (_, fy, cy), _ = like.camera.intrinsics.tolist()
    width, height, lens = (entry.get(key, said.get(key)) for key in ("width", "height", "intrinsics"))
    if (width is None) != (height is None) or (width is not None and lens is None):
        raise ValueError(f"{where}: width, height and intrinsics go together, or intrinsics stand alone")
    if width is None:
        width, height = like.camera.width, like.camera.height
    width, height = _size(width, height, f"{where}: ")
    numbers = _numbers([fx, fy, cx, cy] if lens is None else lens, (4,), f"{where}: intrinsics").tolist()
    if not (numbers[0] > 0 and numbers[1] > 0):
        raise ValueError(f"{where}: focal lengths are above 0, got {numbers[:2]}")
    at = float(_numbers(entry["seconds"], (), f"{where}: seconds"))
    pose = _rigid(_numbers(entry["world_from_camera"], (4, 4), f"{where}: world_from_camera"), where)
    return _Pose(at, pose, (numbers[0], numbers[1], numbers[2], numbers[3]), width, height)


def _splined(keys: Sequence[_Pose], fps: float) -> list[_Pose]:
    """Poses at so many a second on a cubic spline through the keyframes, turned with a continuous acceleration."""
    times = [key.seconds for key in keys]
    if len(keys) < 2 or any(a >= b for a, b in itertools.pairwise(times)):
        raise ValueError(f"keyframes are two or more at increasing seconds, got {times}")
    if len({(key.width, key.height) for key in keys}) > 1:
        raise ValueError("all keyframes have one size")
    count = math.floor((times[-1] - times[0]) * fps + 1e-6) + 1
    wanted = [times[0] + index / fps for index in range(count)]
    poses = np.stack([key.world_from_camera for key in keys])
    places = CubicSpline(times, poses[:, :3, 3], bc_type="natural")(wanted)
    turns = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted).as_matrix()
    lenses = np.array([key.lens for key in keys])
    found = []
    for at, place, turn in zip(wanted, places, turns, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, place
        fx, fy, cx, cy = (float(np.interp(at, times, lenses[:, column])) for column in range(4))
        found.append(_Pose(at, pose, (fx, fy, cx, cy), keys[0].width, keys[0].height))
    return found


def _nerfstudio(said: Mapping[str, Any], last: float, time_of: Callable[[float], float]) -> PathFile:
    """OpenGL's axes (y up, z backward), rows first; fov vertical, degrees; ``render_time`` in [0, 1] of the log.

    Without render_time the log runs at its own speed, and its last instant stays.
    """
    kind = said.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"camera_type is {kind!r}, and only perspective cameras are rendered")
    width, height = _size(said.get("render_width"), said.get("render_height"), "render_")
    fps = float(_numbers(said.get("fps", 24), (), "fps"))
    if not 0 < fps <= _FASTEST:
        raise ValueError(f"fps is above 0 and at most {_FASTEST}, got {fps:g}")
    rigs = []
    for index, entry in enumerate(said["camera_path"]):
        where = f"camera_path[{index}]"
        if not isinstance(entry, dict) or not {"camera_to_world", "fov"} <= entry.keys():
            raise ValueError(f"{where} has camera_to_world and fov")
        fov = float(_numbers(entry["fov"], (), f"{where}: fov"))
        if not 0 < fov < 180:
            raise ValueError(f"{where}: fov lies between 0 and 180 degrees, got {fov:g}")
        rows = entry["camera_to_world"]
        nested = isinstance(rows, list) and len(rows) == 4  # nerfstudio writes them one behind the other, others do not
        table = _numbers(rows, (4, 4) if nested else (16,), f"{where}: camera_to_world")
        pose = _rigid(np.reshape(table, (4, 4)), where)
        at = min(index / fps, last)
        if entry.get("render_time") is not None:
            at = last * float(_numbers(entry["render_time"], (), f"{where}: render_time"))
        focal = height / 2 / math.tan(math.radians(fov) / 2)
        lens = (focal, focal, width / 2, height / 2)
        rigs.append((_Pose(at, pose @ _OPENCV_FROM_OPENGL, lens, width, height).view(time_of),))
    return PathFile(tuple(rigs), fps, "the crop of the path's file has no effect" if said.get("crop") else None)


def _size(width: Any, height: Any, where: str) -> tuple[int, int]:
    for side in (width, height):
        whole = isinstance(side, int | float) and not isinstance(side, bool) and side == side // 1
        if not whole or not 0 < side <= _LARGEST:
            raise ValueError(f"{where}width and height are pixels, 1 to {_LARGEST}, got {width!r} and {height!r}")
    return int(width), int(height)


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> Float64[np.ndarray, "..."]:
    try:
        found = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} is no number or table of numbers: {value!r}") from error
    if found.shape != shape or not np.isfinite(found).all():
        size = " x ".join(map(str, shape)) or "one"
        raise ValueError(f"{where} has {size} finite numbers, got {value!r}")
    return found


def _rigid(pose: Float64[np.ndarray, "4 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    error = rigidity_error(torch.from_numpy(pose))
    if not error < _RIGID:
        raise ValueError(f"{where}: a pose turns and moves alone, but is off by {error:.2g}: it may be scaled")
    pose = pose.copy()
    pose[:3, :3] = Rotation.from_matrix(pose[:3, :3]).as_matrix()
    return pose
