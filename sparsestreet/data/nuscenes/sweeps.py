"""Lidar sweeps from their files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.lidar import check_points
from sparsestreet.data.problems import fault
from sparsestreet.geometry.cameras import transform_points

COLUMNS = 5
"""float32: x, y, z in meters, intensity, ring."""
_LARGEST = 100_000_000
"""Bytes; a genuine sweep of 35,000 returns has 0.7 MB."""
OWN_CAR = 2.5
"""Meters from the lidar: nearer returns are of the recording car, or none at all (zeros)."""
_REMEDY = "extract the file again from the data set's archive, or read the log without lidar (data.log.lidar=false)"


def check_sweep_size(path: Path) -> None:
    """Raises LogError unless the file holds whole rows, of a number that a sweep can have."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise fault(path, f"the sweep cannot be read ({error})", _REMEDY) from error
    if size % (4 * COLUMNS) or size > _LARGEST:
        message = f"{size} bytes are no whole number of rows of {COLUMNS} float32, or more than {_LARGEST}"
        raise fault(path, message, _REMEDY)


def read_sweep(path: Path, world_from_lidar: Float64[Tensor, "4 4"]) -> Float64[Tensor, "n 3"]:
    """Points in nuScenes' world, without those of the recording car.

    The publisher has moved them by the car's own motion to the sweep's stamp. Raises LogError for a broken file.
    """
    check_sweep_size(path)
    try:
        check_regular(path)
        rows = np.fromfile(path, dtype="<f4").reshape(-1, COLUMNS)
    except OSError as error:
        raise fault(path, f"the sweep cannot be read ({error})", _REMEDY) from error
    points = torch.from_numpy(rows[:, :3].astype(np.float64))
    check_points(points, path, remedy=_REMEDY)
    return transform_points(world_from_lidar, points[points.norm(dim=1) >= OWN_CAR])
