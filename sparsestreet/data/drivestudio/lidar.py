"""Lidar sweeps: points in the world, their colors, and the depth they give to pixels."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, UInt8
from torch import Tensor

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.drivestudio.poses import read_pose
from sparsestreet.data.drivestudio.problems import fault
from sparsestreet.geometry.cameras import project
from sparsestreet.geometry.transforms import transform_points
from sparsestreet.types import Camera

_FARTHEST = 1000.0
"""Meters: no street lidar reaches this far, so a point beyond it is not a point."""


def check_sweep_size(layout: Layout, frame: int) -> None:
    """Raises LogError unless the file holds whole rows."""
    path, row = layout.sweep(frame), 4 * layout.sweep_columns
    if path.stat().st_size % row:
        message = f"{path.stat().st_size} bytes are no whole number of rows of {layout.sweep_columns} float32"
        remedy = (
            f"write float32 rows of {layout.sweep_columns} columns ({'Waymo' if layout.waymo else 'nuScenes'} flavour)"
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


def color_points(
    points: Float[Tensor, "n 3"], views: Sequence[tuple[Camera, UInt8[Tensor, "_ _ 3"]]]
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
    """RGB in [0, 1] from the pixel each point falls into, and which points any camera sees; the others are gray.

    Where several cameras see a point the first one counts. As in DriveStudio nothing tests whether the camera's view
    of the point is blocked: lidar and cameras sit close together.
    """
    colors = torch.full((points.shape[0], 3), 0.5)
    colored = torch.zeros(points.shape[0], dtype=torch.bool)
    for camera, image in views:
        rows, pixels, _ = visible_pixels(camera, points)
        new = ~colored[rows]
        colors[rows[new]] = image.reshape(-1, 3)[pixels[new]].float() / 255
        colored[rows] = True
    return colors, colored


def depth_image(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Depth along the optical axis in meters of the nearest point in each pixel; 0 where there is none."""
    _, pixels, depths = visible_pixels(camera, points)
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest.scatter_reduce_(0, pixels, depths.float(), "amin")
    return torch.where(nearest.isinf(), 0.0, nearest).view(camera.height, camera.width)


def visible_pixels(
    camera: Camera, points: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, " v"], Int[Tensor, " v"], Float[Tensor, " v"]]:
    """For the points inside the image: their rows, the pixel (row-major) each falls into, and its depth in meters."""
    positions, depths, inside = project(camera, points)
    rows = torch.nonzero(inside).squeeze(-1)
    column, line = positions[rows].long().unbind(-1)
    return rows, line * camera.width + column, depths[rows]


def _check_points(points: Float64[Tensor, "n 3"], path: Path) -> None:
    # A NaN compares false, so it counts as broken too.
    broken = int((~(points.abs() <= _FARTHEST)).any(-1).sum())
    if broken:
        message = f"{broken} of {points.shape[0]} points are NaN, infinite or more than {_FARTHEST:g} m away"
        raise fault(path, message, "drop these returns, and make sure that the rows have the flavour's columns")
