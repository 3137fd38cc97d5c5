"""The layer of the log's lidar: returns where a pinhole has them, of the sweep that is nearest in time."""

import numpy as np
import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.export.layers import layer_picture, layer_pictures, layer_values
from sparsestreet.export.lidar import FARTHEST, LidarReturns, enlarged
from sparsestreet.export.path import recorded
from sparsestreet.types import Sweep
from tests.export.street import stored_street, street_views

VIEW = street_views(cameras=(0,))[1]
"""At time 0.25."""


def seen_at(column: float, line: float, depth: float) -> list[float]:
    """The world's point that the view's pinhole has there."""
    camera = VIEW.camera
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.double().tolist()
    point = np.array([(column - cx) / fx * depth, (line - cy) / fy * depth, depth, 1.0])
    return (np.linalg.inv(camera.camera_from_world.double().numpy()) @ point)[:3].tolist()


def returns(points: dict[int, list[list[float]]]) -> LidarReturns:
    """Sweeps of frames 0 to 4, which are at times 0 to 1."""
    read = []

    def load(frame: int) -> Sweep:
        read.append(frame)
        places = torch.tensor(points[frame]).reshape(-1, 3)
        return Sweep(frame, frame / 4, places, torch.zeros_like(places), torch.zeros(len(places), dtype=torch.bool))

    made = LidarReturns(Sweeps(points, load), {frame: frame / 4 for frame in points})
    made.__dict__["read"] = read
    return made


def test_the_nearest_return_of_a_pixel_in_millimeters():
    places = [seen_at(10.5, 7.5, 12.345), seen_at(10.4, 7.6, 20.0), seen_at(40.5, 30.5, 80.0), seen_at(20.5, 9.5, -3.0)]
    values = layer_values(stored_street(), VIEW, ["lidar"], returns({1: places}))["lidar"]
    assert values.dtype == np.uint16
    assert values[7, 10] == 12345
    assert values[30, 40] == FARTHEST
    assert np.count_nonzero(values) == 2


def test_the_sweep_that_is_nearest_in_time_is_read_once_for_all_cameras():
    log = returns({frame: [seen_at(frame + 0.5, 0.5, 5.0)] for frame in (0, 1, 4)})
    for time, frame in ((0.0, 0), (0.2, 1), (0.3, 1), (0.6, 1), (0.7, 4)):
        assert np.flatnonzero(log.millimeters(VIEW.camera, time)).tolist() == [frame]
    assert log.__dict__["read"] == [0, 1, 4]


def test_dots_lie_on_the_picture():
    log = returns({1: [seen_at(10.5, 7.5, 5.0)]})
    path = recorded([VIEW])
    (picture,) = layer_pictures(stored_street(), path, ["rgb", "lidar"], log)
    rgb, dots = picture[:32], picture[32:]
    changed = np.argwhere((rgb // 2 != dots).any(-1))
    assert changed.tolist() == [[7, 10]]
    (alone,) = layer_pictures(stored_street(), path, ["lidar"], log)
    assert np.array_equal(alone, dots)
    near, far = (layer_picture("lidar", np.array([[mm]], np.uint16), []).sum() for mm in (2000, 60_000))
    assert near > far > 0


def test_dots_grow_with_the_picture_and_the_nearer_one_wins():
    values = np.zeros((3, 4), np.uint16)
    values[0, 0], values[1, 1] = 9, 5
    assert enlarged(values, 1).tolist() == values.tolist()
    assert enlarged(values, 2).tolist() == [[9, 9, 0, 0], [9, 5, 5, 0], [0, 5, 5, 0]]
    wide = np.zeros((2, 640), np.uint16)
    wide[0, 0] = 1000
    assert np.count_nonzero(layer_picture("lidar", wide, []).any(-1)) == 4


def test_without_a_log_it_is_refused():
    with pytest.raises(ValueError, match="made of a log's returns"):
        layer_values(stored_street(), VIEW, ["lidar"])
