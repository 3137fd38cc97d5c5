"""Turns of a lidar: ranges, frames and seconds by hand, while sensor and objects move."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.data.lidar_models import LidarModel
from sparsestreet.scene.sweeps import render_sweep
from tests.scene.test_lidar import OPTIONS, crooked_pose, in_world, moving_ball, rows_at, scene_of, unit, wall_and_box


def model_of(elevations: list[float], azimuths: list[float], offsets: list[float] | None = None) -> LidarModel:
    """Degrees; a turn takes 0.1 s."""
    rows, columns = (torch.tensor(one, dtype=torch.float64).deg2rad() for one in (elevations, azimuths))
    beside = torch.tensor(offsets or [0.0] * len(elevations), dtype=torch.float64).deg2rad()
    return LidarModel("by hand", rows, beside, columns, 0.1, 100.0, "by hand")


def still(_: float) -> Tensor:
    return torch.eye(4, dtype=torch.float64)


def test_a_turn_meets_a_wall_and_a_box_where_they_are():
    """The box's front is at x = 5 m and ends at 5.7 degrees, its wall at 10 m; an offset is 6 degrees."""
    model = model_of([2.0, -3.0, 0.5], [11.0, 3.0, -2.5, -9.0], [0.0, 0.0, 6.0])
    found = render_sweep(wall_and_box(), model, still, 0.5, OPTIONS, duration=2.0)
    walls = [10, 10, 10, 5, 5, 10, 5, 5, 5, 10, 10, 5]  # of columns at 11, 3, -2.5, -9, and 17, 9, 3.5, -3
    along = torch.tensor([11.0, 11.0, 17.0, 3.0, 3.0, 9.0, -2.5, -2.5, 3.5, -9.0, -9.0, -3.0])
    up = torch.tensor([2.0, -3.0, 0.5]).repeat(4)
    expected = torch.tensor(walls)[:, None] / unit(along, up)[:, :1] * unit(along, up)
    inside = (expected[:, 1:].abs() < 3).all(1)
    assert int((~inside).sum()) == 1  # one ray passes beside the wall, and is no return
    torch.testing.assert_close(found.points, expected[inside], rtol=0, atol=0.05)
    when = torch.tensor([-0.05, -0.025, 0.0, 0.025]).double().repeat_interleave(3)
    torch.testing.assert_close(found.seconds, when[inside])
    assert found.intensities.tolist() == [0.0] * 11


def test_nothing_returns_from_beyond_the_reach():
    model = replace(model_of([0.0], [3.0, -9.0]), reach=8.0)
    assert len(render_sweep(wall_and_box(), model, still, 0.5, OPTIONS, duration=2.0)) == 1
    assert len(render_sweep(wall_and_box(), replace(model, reach=4.0), still, 0.5, OPTIONS, duration=2.0)) == 0


@pytest.mark.parametrize(
    ("clockwise", "expected"), [(True, 11 - 20 * 0.1 * 102 / 360), (False, 11 + 20 * 0.1 * 102 / 360)]
)
def test_the_direction_of_the_turn_says_when_an_azimuth_is_seen(clockwise, expected):
    """Of 360 columns from 190 degrees, of which 10 degrees are in the middle of the turn either way.

    The ball at 100 degrees goes away at 20 m/s, and is at 11 m at the instant. Its view is of the time of its middle
    column, that of 112 degrees.
    """
    columns = [190.0 - one if clockwise else 190.0 + one for one in range(360)]
    found = render_sweep(moving_ball(20.0), model_of([0.0], columns), still, 0.5, OPTIONS, duration=2.0)
    row = int(
        (found.points / found.points.norm(dim=1)[:, None] @ unit(torch.tensor([100.0]), torch.zeros(1))[0]).argmax()
    )
    assert float(found.seconds[row]) == pytest.approx(-0.025 if clockwise else 0.025)
    # The first from 190 degrees clockwise sees 112 degrees 78 columns later, 102 before the middle.
    assert float(found.points[row].norm()) == pytest.approx(expected, abs=0.01)


def test_points_of_a_moving_sensor_lie_on_what_stands_still():
    """A sensor at 20 m/s, turning, tilted, far from the origin: balls are where its frame of the instant has them."""
    azimuths = torch.tensor([170.0, 100.0, 20.0, -60.0, -160.0])
    ahead = 12 * unit(azimuths, torch.zeros(5))
    scene = scene_of(rows_at(in_world(ahead, crooked_pose()), (0.3, 0.3, 0.3)))

    def drives(seconds: float) -> Tensor:
        yaw, moved = torch.tensor(0.5 * seconds), torch.eye(4, dtype=torch.float64)
        moved[:2, :2] = torch.tensor([[yaw.cos(), -yaw.sin()], [yaw.sin(), yaw.cos()]])
        moved[:3, 3] = torch.tensor([20.0, 1.0, 0.0]) * seconds
        return crooked_pose() @ moved

    model = model_of([-0.4, 0.0, 0.4], [180 - 0.3 * one for one in range(1200)])
    found = render_sweep(scene, model, drives, 0.5, OPTIONS, duration=2.0)
    for place in ahead:
        near = found.points[(found.points - place).norm(dim=1) < 1.0]
        assert len(near) > 3
        # A depth along the axis of a view is that of the ball's middle: 0.4 m beside it, at up to 22 degrees, 0.16 m.
        toward = place / place.norm()
        assert float(((near - place) @ toward).abs().max()) < 0.16
        torch.testing.assert_close(near.mean(0), place, rtol=0, atol=0.03)
    assert float((found.points[:, None] - ahead).norm(dim=2).amin(1).max()) < 0.7


def test_a_turn_may_end_at_its_instant():
    model = model_of([0.0], [100.3, 100.0, 99.7])
    found = render_sweep(moving_ball(20.0), model, still, 0.5, OPTIONS, duration=2.0, span=(-0.3, 0.0))
    torch.testing.assert_close(found.seconds, torch.tensor([-0.3, -0.2, -0.1]).double())


def test_beyond_the_log_objects_stand_still():
    """The ball is at 31 m when the log ends; half a turn later it would be at 32 m, or gone."""
    model = model_of([0.0], [100.2, 100.0])
    found = render_sweep(moving_ball(20.0), model, still, 1.0, OPTIONS, duration=2.0, span=(0.0, 0.1))
    assert float(found.points[1].norm()) == pytest.approx(31, abs=0.02)
