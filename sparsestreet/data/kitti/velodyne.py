"""Sweeps of the Velodyne on KITTI's cars, as recorded: each point where the sensor saw it at its own instant."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.lidar import check_points
from sparsestreet.data.problems import fault

OWN_CAR = 2.5
"""Meters: in the sample of drive 2011_09_26_0005 the 34 returns nearer than this are of the car, the next is at 2.6."""
_ROW = 16
_LARGEST = 1 << 24
"""Bytes, a million points; a sweep has 120,000."""
_REMEDY = "copy it again from the published archive, or remove it to read its frame without lidar"


def read_points(path: Path) -> Float64[Tensor, "n 3"]:
    """x forward, y left, z up, without the returns of the own car; raises LogError for a file that is no sweep."""
    try:
        size = path.stat().st_size
        if size % _ROW or size > _LARGEST:
            message = f"{size} bytes are no whole number of rows of 4 float32, or more than {_LARGEST}"
            raise fault(path, message, _REMEDY)
        check_regular(path)
        rows = np.fromfile(path, dtype="<f4").reshape(-1, 4)
    except OSError as error:
        raise fault(path, f"the file cannot be read ({error})", _REMEDY) from error
    points = torch.from_numpy(rows[:, :3].copy()).double()
    check_points(points, path, remedy=_REMEDY)
    return points[points.norm(dim=-1) >= OWN_CAR]


def point_stamps(points: Float64[Tensor, "n 3"], begin: int, end: int) -> Int64[Tensor, " n"]:
    """When each point was measured in a turn from ``begin`` to ``end``, nanoseconds.

    Seen from above the sensor turns clockwise, from behind over left, front and right:
    begin + (pi - atan2(y, x)) / (2 pi) (end - begin). KITTI's readme says counter-clockwise, but edges of the lidar lie
    on edges of the images best for a clockwise turn (tests/data/kitti/test_sample.py), and KITTI-360's development kit
    moves points so too.
    """
    fraction = (torch.pi - torch.atan2(points[:, 1], points[:, 0])) / (2 * torch.pi)
    return begin + (fraction * (end - begin)).round().long()
