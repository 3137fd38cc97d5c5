"""Lidar sweeps from their files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.drivestudio.poses import read_pose
from sparsestreet.data.problems import fault
from sparsestreet.geometry.transforms import transform_points

_FARTHEST = 1000.0
"""Meters: no street lidar reaches this far, so a point beyond it is not a point."""


def check_sweep_size(layout: Layout, frame: int) -> None:
    """Raises LogError unless the file holds whole rows."""
    path, row = layout.sweep(frame), 4 * layout.sweep_columns
    if path.stat().st_size % row:
        message = f"{path.stat().st_size} bytes are no whole number of rows of {layout.sweep_columns} float32"
        remedy = (
            f"write float32 rows of {layout.sweep_columns} columns ({'Waymo' if layout.waymo else 'nuScenes'} flavor)"
        )
        raise fault(path, message, remedy)


def read_sweep(layout: Layout, frame: int) -> Float64[Tensor, "n 3"]:
    """Points of one instant in the data set's world, meters; raises LogError for broken rows or a broken pose."""
    check_sweep_size(layout, frame)
    path = layout.sweep(frame)
    rows = np.fromfile(path, dtype="<f4").reshape(-1, layout.sweep_columns)
    points = torch.from_numpy(rows[:, layout.sweep_xyz].astype(np.float64))
    _check_points(points, path)
    return transform_points(read_pose(layout.sweep_pose(frame)), points)


def _check_points(points: Float64[Tensor, "n 3"], path: Path) -> None:
    # A NaN compares false, so it counts as broken too.
    broken = int((~(points.abs() <= _FARTHEST)).any(-1).sum())
    if broken:
        message = f"{broken} of {points.shape[0]} points are NaN, infinite or more than {_FARTHEST:g} m away"
        raise fault(path, message, "drop these returns, and make sure that the rows have the flavor's columns")
