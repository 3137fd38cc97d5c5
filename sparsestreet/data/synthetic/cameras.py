"""The camera rig: places of the cameras on the ego car, and their rays."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import CAMERA_YAWS_DEGREES, StreetSettings
from sparsestreet.data.synthetic.tracer import Rays
from sparsestreet.geometry.distortion import undistort

_EGO_AXES_FROM_CAMERA = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
"""Columns are camera x (right), y (down), z (forward) in ego axes (x forward, y left, z up)."""
_MOUNT = (1.6, 0.0, 1.65)
"""Camera position on the ego car, meters."""


@dataclass(frozen=True)
class StreetCamera:
    """A camera at an instant."""

    world_from_camera: Pose
    intrinsics: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    """Brown-Conrady k1, k2, p1, p2, k3; empty: a pinhole."""

    def rays(self, supersampling: int) -> Rays:
        """Returns supersampling x supersampling evenly spread rays per pixel; a single ray goes through its center."""
        local = self._directions(supersampling)
        world = np.einsum("ij,jhw->ihw", self.world_from_camera[:3, :3], local)
        return Rays(self.world_from_camera[:3, 3].astype(np.float32), np.ascontiguousarray(world, np.float32))

    def axis_cosines(self) -> Float64[np.ndarray, "h w"]:
        """Returns the depth along the optical axis per meter along the ray through each pixel's center."""
        return self._directions(1)[2]

    def _directions(self, supersampling: int) -> Float64[np.ndarray, "3 a b"]:
        x = (np.arange(self.width * supersampling) + 0.5) / supersampling - self.intrinsics[0, 2]
        y = (np.arange(self.height * supersampling) + 0.5) / supersampling - self.intrinsics[1, 2]
        x, y = x / self.intrinsics[0, 0], y / self.intrinsics[1, 1]
        if self.distortion:
            x, y = _undistorted(tuple(x.tolist()), tuple(y.tolist()), self.distortion)
        else:
            y, x = np.meshgrid(y, x, indexing="ij")
        directions = np.stack((x, y, np.ones_like(x)))
        return directions / np.linalg.norm(directions, axis=0)


def street_camera(settings: StreetSettings, index: int, world_from_ego: Pose) -> StreetCamera:
    """Returns camera ``index`` of the rig."""
    ego_from_camera = at(*_MOUNT, yaw=float(np.radians(CAMERA_YAWS_DEGREES[index])))
    ego_from_camera[:3, :3] = ego_from_camera[:3, :3] @ _EGO_AXES_FROM_CAMERA
    focal = settings.width / 2 / np.tan(np.radians(settings.field_of_view) / 2)
    intrinsics = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1]])
    pose = world_from_ego @ ego_from_camera
    return StreetCamera(pose, intrinsics, settings.width, settings.height, tuple(settings.lens))


@lru_cache(maxsize=4)
def _undistorted(
    columns: tuple[float, ...], rows: tuple[float, ...], distortion: tuple[float, ...]
) -> Float64[np.ndarray, "2 a b"]:
    """Returns x and y at which a pinhole images what the lens images in these columns and rows, all normalized.

    The result is cached because all frames of a rig share it: Newton's method takes as long as tracing the rays.
    """
    y, x = np.meshgrid(rows, columns, indexing="ij")
    imaged = torch.from_numpy(np.stack((x, y), -1))
    return undistort(imaged, torch.tensor(distortion, dtype=torch.float64)).movedim(-1, 0).numpy()
