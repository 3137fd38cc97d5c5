"""The cameras of a scene: lenses, sizes, and the rows that show the recording car."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from sparsestreet.data.ego import bottom_rows
from sparsestreet.data.nuscenes.scene import DataFile, SceneFiles
from sparsestreet.data.rig import RigCamera, rig_camera

_LARGEST_SIDE = 1 << 14
"""Pixels; genuine images have 1600x900."""
EGO_ROWS = {"CAM_BACK": 80}
"""Channel -> how many of the lowest rows show the recording car (neurad-studio's nuScenes reader)."""
_EGO_ROWS_OF_SCENES = {"scene-0164": {"CAM_BACK": 146}}
_HEIGHT = 900
"""Rows of the images that these are counted in."""


def recorded_size(files: Sequence[DataFile]) -> tuple[int, int]:
    """(width, height) of a camera's images, as sample_data says. Raises LogError where they differ."""
    sizes = [(file.row.count("width", _LARGEST_SIDE), file.row.count("height", _LARGEST_SIDE)) for file in files]
    for file, size in zip(files, sizes, strict=True):
        if size != sizes[0] or 0 in size:
            raise file.row.fault("width, height", f"must be positive, and those of the camera, {sizes[0]}", size)
    return sizes[0]


def nuscenes_camera(
    scene: SceneFiles,
    name: str,
    index: int,
    files: Sequence[DataFile],
    *,
    width: int | None,
    principal_shift: float | int,
) -> RigCamera[str]:
    """A pinhole: the publisher has taken the lens out of the images. Raises LogError for broken intrinsics.

    Args:
        scene: with the calibrations.
        name: channel.
        index: place in the log's rig.
        files: images of the camera, at least one.
        width: to which images are scaled; None: as recorded.
        principal_shift: pixels that are added to cx and cy.
    """
    intrinsics = [_intrinsics(scene, file) for file in files]
    for file, one in zip(files, intrinsics, strict=True):
        if not np.array_equal(one, intrinsics[0]):
            raise file.row.fault("calibrated_sensor_token", f"must have the intrinsics of all {name}", one.tolist())
    shifted = torch.from_numpy(intrinsics[0].copy())
    shifted[:2, 2] += principal_shift
    return rig_camera(
        name,
        index,
        intrinsics=shifted,
        distortion=torch.zeros(5, dtype=torch.float64),
        recorded_size=recorded_size(files),
        width=width,
    )


def ego_mask(scene: str, camera: RigCamera[str]) -> Bool[Tensor, "h w"] | None:
    """True where the recording car is seen, at the camera's size; None where it is not."""
    rows = {**EGO_ROWS, **_EGO_ROWS_OF_SCENES.get(scene, {})}.get(camera.name)
    return None if rows is None else bottom_rows(camera.size, rows, _HEIGHT)


def _intrinsics(scene: SceneFiles, file: DataFile) -> Float64[np.ndarray, "3 3"]:
    row = scene.calibrations[file.row.text("calibrated_sensor_token")]
    intrinsics = row.numbers("camera_intrinsic", (3, 3))
    pinhole = np.array([[intrinsics[0, 0], 0, intrinsics[0, 2]], [0, intrinsics[1, 1], intrinsics[1, 2]], [0, 0, 1]])
    if not np.array_equal(intrinsics, pinhole) or min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise row.fault(
            "camera_intrinsic", "must be fx 0 cx, 0 fy cy, 0 0 1 with positive fx and fy", intrinsics.tolist()
        )
    return intrinsics
