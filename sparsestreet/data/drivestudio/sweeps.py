"""Lidar sweeps from their files."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.drivestudio.poses import read_pose
from sparsestreet.data.lidar import check_points
from sparsestreet.data.problems import fault
from sparsestreet.geometry.transforms import transform_points

_REMEDY = "drop these returns, and make sure that the rows have the flavor's columns"


def check_sweep_size(layout: Layout, frame: int) -> None:
    """Raises LogError unless the file holds whole rows."""
    path, row = layout.sweep(frame), 4 * layout.sweep_columns
    if path.stat().st_size % row:
        message = f"{path.stat().st_size} bytes are no whole number of rows of {layout.sweep_columns} float32"
        remedy = (
            f"write float32 rows of {layout.sweep_columns} columns ({'Waymo' if layout.waymo else 'nuScenes'} flavor)"
        )
        raise fault(path, message, remedy)


def read_points(
    layout: Layout, origin: Float64[Tensor, "3"], ahead: Sequence[float | int] | None, index: int
) -> Float[Tensor, "n 3"]:
    """Points of a frame of the window in the re-centered world; ``ahead`` and errors as in ``read_sweep``."""
    return (read_sweep(layout, layout.frames[index], ahead) - origin).float()


def read_sweep(layout: Layout, frame: int, ahead: Sequence[float | int] | None = None) -> Float64[Tensor, "n 3"]:
    """Points of one instant in the data set's world, meters; raises LogError for broken rows or a broken pose.

    ``ahead``: of Waymo's points, which lie in the frame of the vehicle, only those with x between these numbers.
    """
    check_sweep_size(layout, frame)
    path = layout.sweep(frame)
    rows = np.fromfile(path, dtype="<f4").reshape(-1, layout.sweep_columns)
    points = torch.from_numpy(rows[:, layout.sweep_xyz].astype(np.float64))
    check_points(points, path, remedy=_REMEDY)
    if ahead is not None and layout.waymo:
        points = points[(points[:, 0] > ahead[0]) & (points[:, 0] < ahead[1])]
    return transform_points(read_pose(layout.sweep_pose(frame)), points)
