"""Sweeps of a lidar as files that others read: .ply, .pcd, KITTI's .bin, and one .json of their poses."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import atomic_file, atomic_folder
from sparsestreet.data.lidar_models import LidarModel
from sparsestreet.records.run import Matrix
from sparsestreet.records.strict_json import EXACT, write_json
from sparsestreet.scene.edits.paths import along
from sparsestreet.scene.storage import StoredScene
from sparsestreet.scene.sweeps import Returns, render_sweep

ENDINGS = (".ply", ".pcd", ".bin")
POSES = "poses.json"
"""Name of the poses in a folder of sweeps; beside a file it has that file's name before it."""
FIELDS = ("x", "y", "z", "intensity", "time")
"""Float32 columns of .ply and .pcd; .bin has the first four. Time is in seconds since the instant of the sweep."""


@dataclass(frozen=True)
class Mounted:
    """A lidar on its way through a street."""

    model: LidarModel
    times: Sequence[float]
    """Normalized, increasing."""
    poses: Float64[np.ndarray, "n 4 4"]
    """world_from_lidar at these times; before and after them it stands still."""
    duration: float
    """Seconds from normalized time 0 to 1."""

    def at(self, time: float) -> Callable[[float], Float64[Tensor, "4 4"]]:
        """Return world_from_lidar by the seconds since a normalized time."""
        return lambda seconds: torch.from_numpy(along(self.times, self.poses, time + seconds / self.duration))


@dataclass(frozen=True)
class Instant:
    """When a sweep is drawn."""

    time: float
    """Normalized."""
    frame: int | None
    """Of the log; None: between its frames, or beside its path."""


def mounted(
    model: LidarModel,
    times: Sequence[float],
    vehicles: Sequence[Float64[np.ndarray, "4 4"]],
    mount: Sequence[float],
    duration: float,
) -> Mounted:
    """Put a lidar on a vehicle.

    Args:
        model: the lidar.
        times: normalized.
        vehicles: world_from_vehicle at these times, x ahead, y left, z up.
        mount: meters ahead, left and up of the vehicle's origin; the lidar's axes are those of the vehicle.
        duration: seconds from normalized time 0 to 1.

    Raises ValueError for times that do not increase, or a log without a duration.
    """
    if any(later <= sooner for sooner, later in pairwise(times)):
        raise ValueError(f"a lidar's path has increasing times, got {list(times[:6])} and so on: sort its poses")
    if not duration > 0:
        raise ValueError("the log has one instant, and a lidar turns while time passes: take a log of more frames")
    vehicle_from_lidar = np.eye(4)
    vehicle_from_lidar[:3, 3] = mount
    return Mounted(model, times, np.stack([one @ vehicle_from_lidar for one in vehicles]), duration)


@dataclass(frozen=True)
class SweepPose:
    """A sweep of a folder."""

    file: str
    frame: int | None
    """Of the log; null: between its frames, or beside its path."""
    seconds: float
    """The instant, since the log's first frame; the turn begins half a turn before it."""
    returns: int
    world_from_lidar: Matrix = field(metadata=EXACT)
    """4x4 at that instant, x ahead, y left, z up; points are in this frame."""


@dataclass(frozen=True)
class SweepPoses:
    """The content of ``poses.json``."""

    lidar: str
    source: str
    """Where its angles are from."""
    rays: int
    """Of a turn."""
    turn_seconds: float
    sweeps: tuple[SweepPose, ...]


def write_sweeps(out: Path, stored: StoredScene, lidar: Mounted, instants: Iterable[Instant], ending: str) -> int:
    """Write a file a sweep and their poses, whole or not at all; return the number of points.

    Args:
        out: a file of one sweep, with its pose in a .json beside it, or a folder that is new or empty.
        stored: what is looked at.
        lidar: where it is.
        instants: of the sweeps.
        ending: ``.ply``, ``.pcd`` or ``.bin``, of the files of a folder; a file has its own.

    Raises ValueError for a file of several sweeps, OSError where nothing can be written.
    """
    if out.suffix:
        (instant,) = instants
        with atomic_file(out) as data, atomic_file(out.with_name(f"{out.stem}_{POSES}")) as poses:
            pose = _write(data, out.name, stored, lidar, instant, out.suffix)
            write_json(poses, _described(lidar, [pose]))
        return pose.returns
    with atomic_folder(out) as folder:
        written = []
        for number, instant in enumerate(instants):
            name = f"{number:05d}{ending}"
            written.append(_write(folder / name, name, stored, lidar, instant, ending))
        write_json(folder / POSES, _described(lidar, written))
    return sum(pose.returns for pose in written)


def _described(lidar: Mounted, sweeps: Sequence[SweepPose]) -> SweepPoses:
    model = lidar.model
    rays = len(model.row_elevations) * len(model.column_azimuths)
    return SweepPoses(model.name, model.source, rays, model.seconds, tuple(sweeps))


def _write(path: Path, name: str, stored: StoredScene, lidar: Mounted, instant: Instant, ending: str) -> SweepPose:
    at = lidar.at(instant.time)
    found = render_sweep(stored.scene, lidar.model, at, instant.time, stored.options, duration=lidar.duration)
    path.write_bytes(encoded(found, ending))
    pose = tuple(tuple(row) for row in at(0.0).tolist())
    return SweepPose(name, instant.frame, instant.time * lidar.duration, len(found), pose)


def encoded(found: Returns, ending: str) -> bytes:
    """Return the bytes of a file: binary, little endian.

    >>> nothing = Returns(*(torch.zeros(*shape, dtype=torch.float64) for shape in ((0, 3), (0,), (0,))))
    >>> encoded(nothing, ".bin")
    b''
    """
    columns = torch.cat((found.points, found.intensities[:, None], found.seconds[:, None]), 1)
    table = columns.numpy().astype("<f4")
    if ending == ".bin":
        return np.ascontiguousarray(table[:, :4]).tobytes()
    return (_ply_header(len(table)) if ending == ".ply" else _pcd_header(len(table))).encode() + table.tobytes()


def _ply_header(count: int) -> str:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in FIELDS), "end_header", ""])


def _pcd_header(count: int) -> str:
    sizes, kinds, counts = (" ".join(word * len(FIELDS)) for word in ("4", "F", "1"))
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {' '.join(FIELDS)}"]
    lines += [f"SIZE {sizes}", f"TYPE {kinds}", f"COUNT {counts}", f"WIDTH {count}", "HEIGHT 1"]
    return "\n".join([*lines, "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", "DATA binary", ""])
