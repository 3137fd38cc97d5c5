"""Other cameras on the same path: higher, with another field of view, of another size."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from sparsestreet.export.path import CameraPath, bare
from sparsestreet.geometry.cameras import moved
from sparsestreet.types import Camera


def raised(path: CameraPath, meters: float) -> CameraPath:
    """Returns every camera moved up in the world; the views lose their frame index, as nobody recorded them."""
    vector = torch.tensor([0.0, 0.0, meters], dtype=torch.float64)
    rigs = [[replace(bare(view), camera=moved(view.camera, vector), frame_index=None) for view in rig] for rig in path]
    return tuple(tuple(rig) for rig in rigs)


def cropped(path: CameraPath, height: int) -> CameraPath:
    """Returns images so many pixels high: as many rows come or go above as below, and nothing is scaled."""

    def change(camera: Camera) -> Camera:
        matrix = camera.intrinsics.clone()
        matrix[1, 2] += (height - camera.height) / 2
        return replace(camera, intrinsics=matrix, height=height)

    return _each_camera(path, change)


def pinholes(path: CameraPath, fov: float) -> CameraPath:
    """Returns pinholes of a horizontal field of view, degrees, with square pixels and their axis in the middle.

    Raises ValueError for a field of view that no pinhole has.
    """
    if not 0 < fov < 180:
        raise ValueError(f"a pinhole sees more than 0 and less than 180 degrees, got fov={fov:g}")

    def change(camera: Camera) -> Camera:
        focal = camera.width / 2 / math.tan(math.radians(fov) / 2)
        return replace(
            camera, intrinsics=intrinsics(focal, focal, camera.width / 2, camera.height / 2), distortion=None
        )

    return _each_camera(path, change)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> torch.Tensor:
    """Returns the matrix of a pinhole, pixels.

    >>> intrinsics(2.0, 3.0, 4.0, 5.0).tolist()
    [[2.0, 0.0, 4.0], [0.0, 3.0, 5.0], [0.0, 0.0, 1.0]]
    """
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _each_camera(path: CameraPath, change: Callable[[Camera], Camera]) -> CameraPath:
    return tuple(tuple(replace(bare(view), camera=change(view.camera)) for view in rig) for rig in path)
