"""Where a log is written: in which flavor, by which numbers of cameras, with which poses in the data set's world."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.classes import KNOWN
from sparsestreet.data.drivestudio.flavors import FLAVORS, UPRIGHT, Flavor
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.motion import PosePath
from sparsestreet.data.poses import AHEAD_FROM_OPENCV
from sparsestreet.data.stamps import frame_stamps
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import View

WrittenFlavor = Literal["auto", "waymo", "nuscenes"]

CAMERAS = {
    "waymo": ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"),
    "nuscenes": ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"),
}
"""The data sets' names of the cameras that DriveStudio knows, by its numbers (datasets/dataset_meta.py)."""
_RIGID = 0.05
"""Meters, and radians, by which a rigid camera may move in a vehicle whose poses come ten times a second."""
_ANY = 2**62


@dataclass(frozen=True)
class Placement:
    """All poses as they are written; the order of views is the log's."""

    flavor: Flavor
    cameras: tuple[int, ...]
    """DriveStudio's number of each camera of the log."""
    world_from_camera: Float64[Tensor, "v 4 4"]
    """With OpenCV's axes."""
    world_from_sweep: Float64[Tensor, "f 4 4"]
    """The frame that points are written in: of a mounted camera's flavor the vehicle, else one with the world's axes at
    the first camera of the instant, because a log does not know where its lidars are."""
    mounts: Float64[Tensor, "c 4 4"] | None
    """Of mounted cameras: vehicle_from_camera, with OpenCV's axes."""


def placed(log: DrivingLog, wanted: WrittenFlavor = "auto") -> Placement:
    """Return where a log is written; "auto" is waymo for what only Waymo's cameras and classes can be, else nuscenes.

    Raises ValueError where the flavor waymo is asked for, and cameras are not known to be rigid on a vehicle.
    """
    seen = torch.stack([dataset_from_camera(log, view) for view in log.views])
    if wanted == "nuscenes" or (wanted == "auto" and not _is_waymo(log)):
        return _with_own_poses(log, seen)
    found = _mounted(log, seen) if log.vehicle is not None else "the log does not tell where its vehicle was"
    if isinstance(found, Placement):
        return found
    if wanted == "auto":
        return _with_own_poses(log, seen)
    raise ValueError(
        f"flavor waymo has cameras that are rigid on a vehicle, but {found}: say flavor=nuscenes, which has a "
        "pose for each image"
    )


def dataset_from_camera(log: DrivingLog, view: View) -> Float64[Tensor, "4 4"]:
    """Return the pose of an image with OpenCV's axes, in the data set's own world."""
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


def _is_waymo(log: DrivingLog) -> bool:
    known = all(track.class_name in KNOWN["waymo"] for track in log.tracks)
    return known and log.vehicle is not None and _numbers(log, "waymo") is not None


def _with_own_poses(log: DrivingLog, seen: Float64[Tensor, "v 4 4"]) -> Placement:
    sweeps = torch.eye(4, dtype=torch.float64).repeat(log.num_frames, 1, 1)
    for view, pose in zip(reversed(log.views), seen.flip(0), strict=True):
        sweeps[view.indices[0], :3, 3] = pose[:3, 3]
    return Placement(FLAVORS["nuscenes"], _chosen_numbers(log, "nuscenes"), seen, sweeps, None)


def _mounted(log: DrivingLog, seen: Float64[Tensor, "v 4 4"]) -> Placement | str:
    """The placement, or what speaks against it."""
    indices = torch.tensor([view.indices for view in log.views])
    own = inverse(_vehicle(log, indices[:, 0], [view.stamp for view in log.views])) @ seen
    # Its middle image lies between poses of the vehicle, where the first and the last may lie beyond them.
    places = [torch.nonzero(indices[:, 1] == camera).flatten() for camera in range(log.num_cameras)]
    mounts = torch.stack([own[some[len(some) // 2]] for some in places])
    apart = (own - mounts[indices[:, 1]]).flatten(1).abs().amax(1)
    if float(apart.max()) > _RIGID:
        name = (log.camera_names or tuple(map(str, range(log.num_cameras))))[int(indices[apart.argmax(), 1])]
        return f"camera {name} moves by up to {float(apart.max()):.2g} (meters or radians) in its own"
    if float((mounts @ inverse(AHEAD_FROM_OPENCV))[:, 2, 2].min()) < UPRIGHT:
        return "a camera is not upright in its own"
    frames = torch.arange(log.num_frames)
    vehicle = _vehicle(log, frames, frame_stamps(log) or [None] * log.num_frames)
    poses = vehicle[indices[:, 0]] @ mounts[indices[:, 1]]
    return Placement(FLAVORS["waymo"], _chosen_numbers(log, "waymo"), poses, vehicle, mounts)


def _vehicle(log: DrivingLog, frames: Tensor, stamps: Sequence[int | None]) -> Float64[Tensor, "n 4 4"]:
    """world_from_vehicle at instants that belong to frames, in the data set's world."""
    assert log.vehicle is not None  # as the callers know
    poses, own = log.vehicle.poses, log.vehicle.stamps
    if own is None:
        return log.dataset_from_world @ poses[frames]
    path = PosePath(torch.tensor(own), log.dataset_from_world @ poses, _ANY)
    return path.at(torch.tensor([stamp for stamp in stamps if stamp is not None]))


def _chosen_numbers(log: DrivingLog, flavor: str) -> tuple[int, ...]:
    return _numbers(log, flavor) or tuple(range(log.num_cameras))


def _numbers(log: DrivingLog, flavor: str) -> tuple[int, ...] | None:
    """DriveStudio's, of cameras whose names are the flavor's, or numbers already; None: they are others."""
    names, known = log.camera_names, CAMERAS[flavor]
    if names and all(name in known for name in names):
        return tuple(map(known.index, names))
    if names and all(name.isascii() and name.isdigit() and str(int(name)) == name for name in names):
        return tuple(map(int, names))
    return None
