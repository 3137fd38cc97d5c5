"""The camera rig: where the cameras sit on the ego car and which rays they send."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import CAMERA_YAWS_DEGREES, StreetSettings
from sparsestreet.data.synthetic.tracer import Rays

_EGO_AXES_FROM_CAMERA = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
"""Columns: camera x (right), y (down), z (forward) in ego axes (x forward, y left, z up)."""
_MOUNT = (1.6, 0.0, 1.65)
"""Camera position on the ego car, meters."""


@dataclass(frozen=True)
class StreetCamera:
    """A pinhole at an instant."""

    world_from_camera: Pose
    intrinsics: Float64[np.ndarray, "3 3"]
    width: int
    height: int

    def rays(self, supersampling: int) -> Rays:
        """supersampling x supersampling rays per pixel, evenly spread; one ray goes through the pixel's center."""
        local = self._directions(supersampling)
        world = np.einsum("ij,jhw->ihw", self.world_from_camera[:3, :3], local)
        return Rays(self.world_from_camera[:3, 3].astype(np.float32), np.ascontiguousarray(world, np.float32))

    def axis_cosines(self) -> Float64[np.ndarray, "h w"]:
        """Depth along the optical axis per meter along the ray through each pixel's center."""
        return self._directions(1)[2]

    def _directions(self, supersampling: int) -> Float64[np.ndarray, "3 a b"]:
        x = (np.arange(self.width * supersampling) + 0.5) / supersampling - self.intrinsics[0, 2]
        y = (np.arange(self.height * supersampling) + 0.5) / supersampling - self.intrinsics[1, 2]
        y, x = np.meshgrid(y / self.intrinsics[1, 1], x / self.intrinsics[0, 0], indexing="ij")
        directions = np.stack((x, y, np.ones_like(x)))
        return directions / np.linalg.norm(directions, axis=0)


def street_camera(settings: StreetSettings, index: int, world_from_ego: Pose) -> StreetCamera:
    """Camera ``index`` of the rig."""
    ego_from_camera = at(*_MOUNT, yaw=float(np.radians(CAMERA_YAWS_DEGREES[index])))
    ego_from_camera[:3, :3] = ego_from_camera[:3, :3] @ _EGO_AXES_FROM_CAMERA
    focal = settings.width / 2 / np.tan(np.radians(settings.field_of_view) / 2)
    intrinsics = np.array([[focal, 0, settings.width / 2], [0, focal, settings.height / 2], [0, 0, 1]])
    return StreetCamera(world_from_ego @ ego_from_camera, intrinsics, settings.width, settings.height)
