"""The vehicle that carried the cameras of a log: layouts have its poses, a log has only those of the cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.log_times import LogTimes
from sparsestreet.data.motion import PosePath
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import View

AHEAD_FROM_OPENCV = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""Axes x ahead, y left, z up, from OpenCV's."""
_LEAST_UP = 0.5
"""Cosine. Boxes that lean farther from the camera's own upright say nothing of how it is mounted."""
_ANY = 2**62


@dataclass(frozen=True)
class Vehicle:
    """A frame with x ahead, y left, z up: the boxes' mean upright is up, where the first camera looks is ahead."""

    path: PosePath
    """dataset_from_vehicle, in the data set's own world, over the stamps of the first camera and beyond."""
    mounts: Mapping[int, Float64[Tensor, "4 4"]]
    """vehicle_from_camera with OpenCV's axes, by camera index: exact for the camera's first image."""

    def at(self, stamp: int) -> Float64[Tensor, "4 4"]:
        return self.path.at(torch.tensor([stamp]))[0]


def dataset_from_camera(log: DrivingLog, view: View) -> Float64[Tensor, "4 4"]:
    """With OpenCV's axes, in the data set's own world."""
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


def vehicle_of(log: DrivingLog, times: LogTimes, place: Sequence[float | int]) -> Vehicle:
    """The vehicle whose first camera is at ``place`` (meters ahead, left and up)."""
    leading = min(view.indices[1] for view in log.views)
    own = [view for view in log.views if view.camera_index == leading]
    stamps = torch.tensor([times.of_view(view) for view in own])
    path = PosePath(stamps, torch.stack([dataset_from_camera(log, view) for view in own]), _ANY)
    mount = torch.eye(4, dtype=torch.float64)
    mount[:3, :3] = _upright(_up(log, times, path)) @ AHEAD_FROM_OPENCV[:3, :3]
    mount[:3, 3] = torch.tensor(place, dtype=torch.float64)
    path = PosePath(stamps, path.poses @ inverse(mount), _ANY)
    mounts = {leading: mount}
    for view in log.views:
        if view.indices[1] not in mounts:
            back = inverse(path.at(torch.tensor([times.of_view(view)]))[0])
            mounts[view.indices[1]] = back @ dataset_from_camera(log, view)
    return Vehicle(path, dict(sorted(mounts.items())))


def _up(log: DrivingLog, times: LogTimes, path: PosePath) -> Float64[Tensor, "3"]:
    """Mean upright of the boxes, in the axes of the first camera (x ahead, y left, z up)."""
    total = torch.zeros(3, dtype=torch.float64)
    for track in log.tracks:
        stamps = [times.stamp(float(time)) for time in times.timed(track, log.num_frames).times]  # pyright: ignore
        rotations = path.at(torch.tensor(stamps))[:, :3, :3]
        uprights = log.dataset_from_world[:3, :3] @ track.world_from_object[:, :3, 2, None]
        total += (rotations.mT @ uprights).sum(0)[:, 0]
    up = AHEAD_FROM_OPENCV[:3, :3] @ total
    own = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    return up / up.norm() if up.norm() > 0 and up[2] > _LEAST_UP * up.norm() else own


def _upright(up: Float64[Tensor, "3"]) -> Float64[Tensor, "3 3"]:
    """Turns axes x ahead, y left, z up such that ``up`` becomes z and x stays ahead."""
    ahead = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / ahead.norm()
    return torch.stack((ahead, torch.linalg.cross(up, ahead), up))
