"""Shear of a readout, against cases that are computed by hand."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Sweeps
from sparsestreet.evidence.shear import readout_shear
from sparsestreet.types import Camera, Shutter, Sweep, View

INTRINSICS = torch.tensor([[100.0, 0.0, 40.0], [0.0, 100.0, 30.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(torch.eye(4), INTRINSICS, 80, 60)


def view(shutter: Shutter | None, frame: int = 0) -> View:
    return View(replace(CAMERA, shutter=shutter), 0.0, frame, 0)


def shutter(*translation: float, rotation: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Shutter:
    return Shutter(torch.tensor(translation), torch.tensor(rotation))


def sweep(*points: tuple[float, float, float], index: int = 0) -> Sweep:
    count = len(points)
    return Sweep(index, 0.0, torch.tensor(points), torch.zeros(count, 3), torch.zeros(count, dtype=torch.bool))


def test_a_camera_that_moves_aside():
    """100 px of focal length, 0.3 m: 3 px at 10 m. Points behind the camera and beside the image do not count."""
    points = sweep((0.0, 0.0, 10.0), (1.0, 0.5, 10.0), (0.0, 0.0, -1.0), (50.0, 0.0, 10.0))
    found = readout_shear([view(shutter(0.3, 0.0, 0.0)), view(None)], Sweeps.of((points,)))
    assert found.pixels == pytest.approx(3.0, abs=1e-4)
    assert (found.views, found.points) == (1, 2)


def test_a_camera_that_turns():
    """Radians times the focal length, at any distance, where a point is on the axis."""
    turning = shutter(0.0, 0.0, 0.0, rotation=(0.0, 0.02, 0.0))
    found = readout_shear([view(turning)], Sweeps.of((sweep((0.0, 0.0, 7.0), (0.0, 0.0, 70.0)),)))
    assert found.pixels == pytest.approx(2.0, rel=1e-3)  # tan x = x + x^3 / 3


def test_a_camera_that_looks_at_a_point_while_it_passes():
    """To the right by 0.3 m and to the left by 0.03 rad: what is 10 m ahead stays, at 5 m half of the 6 px is left."""
    passing = shutter(0.3, 0.0, 0.0, rotation=(0.0, -0.03, 0.0))
    for depth, pixels in ((10.0, 0.0), (5.0, 3.0)):
        found = readout_shear([view(passing)], Sweeps.of((sweep((0.0, 0.0, depth)),)))
        assert found.pixels == pytest.approx(pixels, abs=1e-2)


def test_without_lidar_points_are_ten_meters_away():
    assert readout_shear([view(shutter(0.3, 0.0, 0.0))], Sweeps.of(())).pixels == pytest.approx(3.0, rel=1e-3)


def test_a_view_is_measured_at_the_sweep_of_its_frame():
    """Frames have gaps: the second sweep is that of frame 5, four times as near as that of frame 0."""
    sweeps = Sweeps.of((sweep((0.0, 0.0, 10.0)), sweep((0.0, 0.0, 2.5), index=5)))
    assert readout_shear([view(shutter(0.3, 0.0, 0.0), 5)], sweeps).pixels == pytest.approx(12.0, rel=1e-3)
    assert readout_shear([view(shutter(0.3, 0.0, 0.0), 0)], sweeps).pixels == pytest.approx(3.0, rel=1e-3)


def test_the_error_is_that_of_the_mean_over_views():
    views = [view(shutter(0.2 + 0.1 * frame, 0.0, 0.0), frame) for frame in range(3)]
    sweeps = Sweeps.of(tuple(sweep((0.0, 0.0, 10.0), index=frame) for frame in range(3)))
    found = readout_shear(views, sweeps)
    assert found.pixels == pytest.approx(3.0, abs=1e-3)  # 2, 3 and 4 px
    assert found.error == pytest.approx(3**-0.5, abs=1e-3)


def test_without_a_shutter_there_is_none():
    with pytest.raises(ValueError, match="no view has one"):
        readout_shear([view(None)], Sweeps.of(()))
