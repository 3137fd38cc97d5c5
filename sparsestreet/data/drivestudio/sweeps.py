"""Lidar sweeps from their files."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.drivestudio.flavors import NAME_IT
from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.drivestudio.poses import read_pose
from sparsestreet.data.lidar import check_points, empty_notes, returned
from sparsestreet.data.problems import fault
from sparsestreet.geometry.cameras import transform_points

_REMEDY = "drop these returns, and make sure that the rows have the flavor's columns"


def check_sweep_size(layout: Layout, frame: int) -> None:
    """Raises LogError unless the file holds whole rows."""
    path, columns = layout.sweep(frame), layout.flavor.columns
    if path.stat().st_size % (4 * columns):
        message = f"{path.stat().st_size} bytes are no whole number of rows of {columns} float32"
        remedy = f"write float32 rows of {columns} columns ({layout.flavor.name} flavor), or {NAME_IT}"
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
    points, rays = _read_rows(layout, frame)
    points = points[returned(points) & returned(rays)]
    if ahead is not None and layout.flavor.name == "waymo":
        points = points[(points[:, 0] > ahead[0]) & (points[:, 0] < ahead[1])]
    return transform_points(read_pose(layout.sweep_pose(frame)), points)


def sweep_notes(layout: Layout) -> list[str]:
    """What is said about points that are no returns."""
    frames = {layout.sweep(frame): frame for frame in layout.frames} if layout.has_lidar else {}
    return empty_notes(lambda path: _read_rows(layout, frames[path])[1], list(frames))


def _read_rows(layout: Layout, frame: int) -> tuple[Float64[Tensor, "n 3"], Float64[Tensor, "n 3"]]:
    """Points as they are written, and seen from the sensor: in a Waymo row the ray's origin comes before its end."""
    check_sweep_size(layout, frame)
    path = layout.sweep(frame)
    check_regular(path)
    rows = np.fromfile(path, dtype="<f4").reshape(-1, layout.flavor.columns)
    first = layout.flavor.x_column
    points = torch.from_numpy(rows[:, first : first + 3].astype(np.float64))
    check_points(points, path, remedy=_REMEDY)
    return points, points - torch.from_numpy(rows[:, :3].astype(np.float64)) if first else points
