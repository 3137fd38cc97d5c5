"""Paths of known shape with errors of known size."""

import math
from collections.abc import Callable

import pytest
import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.trajectories import Trajectories, smoothed

COUNT = 30


def path(size: float, place: Callable[[float], tuple[float, float, float]], turn: float = 0.0) -> Trajectories:
    """One object over 3 s, with a gap; errors of ``size`` meters on each axis, and radians about the vertical."""
    seconds = torch.tensor([0.1 * k for k in range(COUNT + 3) if k not in (9, 10, 20)])
    draw = torch.Generator().manual_seed(1)
    positions = torch.tensor([place(float(t)) for t in seconds]) + size * torch.randn(COUNT, 3, generator=draw)
    yaw = turn * seconds + size * torch.randn(COUNT, generator=draw)
    vectors = torch.stack((torch.zeros(COUNT), torch.zeros(COUNT), yaw), 1)
    everywhere = torch.ones(1, COUNT, dtype=torch.bool)
    quaternions = quat.from_rotation_vector(vectors)[None]
    return Trajectories(seconds[None] / 3, quaternions, positions[None], everywhere, torch.tensor([[0.0, 1.0]]))


def braking(t: float) -> tuple[float, float, float]:
    return 10 * t - t**2, 0.3 * t**2, 0.7


@pytest.mark.parametrize("size", [0.0, 0.02, 0.1])
def test_errors_about_a_smooth_path_nearly_vanish(size: float):
    recorded, exact = path(size, braking, turn=0.3), path(0.0, braking, turn=0.3)
    rotations, shifts = smoothed(recorded)
    off = (recorded.translations + shifts - exact.translations).square().mean().sqrt()
    # A parabola has 3 degrees of freedom of 30: a third of the error stays, with a spline a little more.
    assert off < 0.5 * size + 1e-3
    turned = quat.multiply(recorded.quaternions, quat.from_rotation_vector(rotations))
    beside = quat.to_rotation_vector(quat.multiply(exact.quaternions * torch.tensor([1.0, -1, -1, -1]), turned))
    assert beside[..., 2].square().mean().sqrt() < 0.5 * size + 1e-3


def test_a_path_that_winds_is_no_error():
    """A lane change within a second: 3 m to the side."""
    winding = path(0.0, lambda t: (10 * t, 1.5 * math.tanh(4 * (t - 1.5)), 0.7))
    assert smoothed(winding)[1].abs().max() < 0.02


def test_few_keyframes_and_padding_stay_as_they_are():
    recorded = path(0.1, braking)
    valid = torch.arange(COUNT)[None] < 5
    few = Trajectories(recorded.times, recorded.quaternions, recorded.translations, valid, recorded.spans)
    assert not any(each.any() for each in smoothed(few))
    valid = torch.arange(COUNT)[None] < 12
    part = Trajectories(recorded.times * valid, recorded.quaternions, recorded.translations, valid, recorded.spans)
    rotations, shifts = smoothed(part)
    assert not rotations[0, 12:].any()
    assert not shifts[0, 12:].any()
    assert shifts[0, :12].any()


def test_an_object_that_turns_round_keeps_its_rotations():
    assert not smoothed(path(0.02, braking, turn=2.5))[0].any()
