"""The camera rig: places of the cameras on the ego car, and their rays."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import CAMERA_YAWS_DEGREES, StreetSettings
from sparsestreet.data.synthetic.tracer import Rays
from sparsestreet.geometry.lenses import undistort

_EGO_AXES_FROM_CAMERA = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
"""Columns are camera x (right), y (down), z (forward) in ego axes (x forward, y left, z up)."""
_MOUNT = (1.6, 0.0, 1.65)
"""Camera position on the ego car, meters."""


Window = tuple[slice, slice]
"""Rows and columns of an image, pixels."""
EVERYWHERE: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class StreetCamera:
    """A camera at an instant."""

    world_from_camera: Pose
    intrinsics: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    """Brown-Conrady k1, k2, p1, p2, k3; empty: a pinhole."""

    def rays(self, supersampling: int, window: Window = EVERYWHERE) -> Rays:
        """Returns supersampling x supersampling evenly spread rays per pixel; a single ray goes through its center."""
        local = self._directions(supersampling, window)
        world = np.einsum("ij,jhw->ihw", self.world_from_camera[:3, :3], local)
        return Rays(self.world_from_camera[:3, 3].astype(np.float32), np.ascontiguousarray(world, np.float32))

    def axis_cosines(self, window: Window = EVERYWHERE) -> Float64[np.ndarray, "h w"]:
        """Returns the depth along the optical axis per meter along the ray through each pixel's center."""
        return self._directions(1, window)[2]

    def _directions(self, supersampling: int, window: Window) -> Float64[np.ndarray, "3 a b"]:
        k = self.intrinsics
        focal_and_center = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        rows, columns = (range(size)[part] for size, part in zip((self.height, self.width), window, strict=True))
        within = tuple(slice(part.start * supersampling, part.stop * supersampling) for part in (rows, columns))
        return _directions(self.width, self.height, focal_and_center, self.distortion, supersampling)[:, *within]


def street_camera(settings: StreetSettings, index: int, world_from_ego: Pose) -> StreetCamera:
    """Returns camera ``index`` of the rig."""
    ego_from_camera = at(*_MOUNT, yaw=float(np.radians(CAMERA_YAWS_DEGREES[index])))
    ego_from_camera[:3, :3] = ego_from_camera[:3, :3] @ _EGO_AXES_FROM_CAMERA
    focal = settings.width / 2 / np.tan(np.radians(settings.field_of_view) / 2)
    intrinsics = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1]])
    pose = world_from_ego @ ego_from_camera
    return StreetCamera(pose, intrinsics, settings.width, settings.height, tuple(settings.lens))


@lru_cache(maxsize=4)
def _directions(
    width: int, height: int, focal_and_center: tuple[float, ...], distortion: tuple[float, ...], supersampling: int
) -> Float64[np.ndarray, "3 a b"]:
    """Returns unit vectors in the camera frame.

    The result is cached because all frames of a rig share it: Newton's method takes as long as tracing the rays.
    """
    fx, fy, cx, cy = focal_and_center
    x = ((np.arange(width * supersampling) + 0.5) / supersampling - cx) / fx
    y = ((np.arange(height * supersampling) + 0.5) / supersampling - cy) / fy
    y, x = np.meshgrid(y, x, indexing="ij")
    if distortion:
        imaged = torch.from_numpy(np.stack((x, y), -1))
        x, y = undistort(imaged, torch.tensor(distortion, dtype=torch.float64)).movedim(-1, 0).numpy()
    directions = np.stack((x, y, np.ones_like(x)))
    directions /= np.linalg.norm(directions, axis=0)
    directions.flags.writeable = False
    return directions
