"""What moves, and what only trembles: random noise, slow and fast, there and back, strays."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sparsestreet.geometry.displacement import displacement, position_noise
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.types import Track

pytestmark = pytest.mark.lengthy

SEEDS = st.integers(0, 2**31 - 1)
NOISE = st.floats(1e-3, 0.5)  # meters, of an axis
COUNTS = st.integers(20, 200)  # below some 20 boxes the estimate of the noise is rough


def track(centers: Tensor, frames: Tensor | None = None) -> Track:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(centers), 1, 1)
    poses[:, :3, 3] = centers.double()
    return Track("car", "Car", torch.arange(len(poses)) if frames is None else frames, poses, torch.ones(3))


def along_x(x: Tensor) -> Tensor:
    return torch.stack((x.double(), torch.zeros(len(x)).double(), torch.zeros(len(x)).double()), 1)


def errors(count: int, deviation: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return deviation * torch.randn(count, 3, generator=generator, dtype=torch.float64)


@given(SEEDS, NOISE, COUNTS)
@settings(max_examples=200, deadline=None)
def test_what_trembles_stays_where_it_is(seed, deviation, count):
    trembling = track(errors(count, deviation, seed))
    assert displacement(trembling) == 0.0
    # The sum of steps has each of them: 2.26 deviations of two normal errors in three dimensions; a half is far below.
    assert trembling.path_length > deviation * count


@given(SEEDS, st.floats(1e-3, 0.02), st.floats(0, 2 * math.pi))
@settings(max_examples=100, deadline=None)
def test_a_slow_mover_moves(seed, deviation, heading):
    """One meter in twenty seconds, ten boxes a second."""
    direction = torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
    centers = torch.linspace(0, 1, 201, dtype=torch.float64)[:, None] * direction
    # Errors of both ends, and of those near them, add; each stays below five deviations.
    assert displacement(track(centers + errors(201, deviation, seed))) == pytest.approx(1.0, abs=10 * deviation)


@given(SEEDS, st.floats(1e-3, 0.3), st.integers(10, 200), st.floats(10.0, 100.0))
@settings(max_examples=100, deadline=None)
def test_who_drives_and_comes_back_has_moved(seed, deviation, count, far):
    there = far * torch.sin(torch.linspace(0, math.pi, count, dtype=torch.float64))
    assert displacement(track(along_x(there) + errors(count, deviation, seed))) > 0.8 * far


@given(SEEDS, st.floats(0.0, 0.2), st.integers(3, 60), st.integers(0, 59), st.floats(2.0, 1000.0))
@settings(max_examples=200, deadline=None)
def test_a_stray_box_moves_nothing(seed, deviation, count, place, off):
    centers = errors(count, deviation, seed)
    centers[place % count, 1] += off
    assert displacement(track(centers)) < 1.0 if count < 20 else displacement(track(centers)) == 0.0


@given(st.integers(10, 60), st.integers(0, 59), st.floats(2.0, 1000.0))
@settings(max_examples=100, deadline=None)
def test_a_stray_box_of_a_mover_adds_nothing(count, place, off):
    centers = along_x(torch.arange(count))
    centers[place % count, 2] += off
    # A median is a neighbor of what it replaces: at an end it may be a step short.
    assert displacement(track(centers)) == pytest.approx(count - 1, abs=2.0)


@given(SEEDS, st.integers(2, 30))
@settings(max_examples=50, deadline=None)
def test_without_noise_it_is_the_diameter_however_the_world_turns(seed, count):
    generator = torch.Generator().manual_seed(seed)
    frames = torch.randint(1, 4, (count,), generator=generator).cumsum(0)
    # Straight on at a changing speed: the diameter is the distance of the ends.
    speed = torch.linspace(1, 1.5, count, dtype=torch.float64)
    x = (speed * torch.diff(frames, prepend=frames[:1])).cumsum(0)
    turn = to_matrix(torch.randn(1, 4, generator=generator, dtype=torch.float64))[0]
    centers = along_x(x) @ turn.T + 1e5 * torch.randn(3, generator=generator, dtype=torch.float64)
    # Medians of three keep a line. An end is cut where its step is more than twice the next: by 4.5 - 2 and 3.75 - 2.
    assert displacement(track(centers, frames)) == pytest.approx(float(x[-1] - x[0]), abs=4.3)
    assert displacement(track(centers, frames)) <= track(centers, frames).path_length + 1e-6  # 1e5 m in 16 digits


@pytest.mark.parametrize("every", [1, 3])
def test_the_noise_is_measured(every):
    """Along a curve, with gaps, and with one box in ten astray."""
    generator = torch.Generator().manual_seed(3)
    frames = torch.randint(1, 1 + every, (5000,), generator=generator).cumsum(0)
    angle = frames.double() / 200
    curve = 50 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    deviations = torch.tensor([0.1, 0.05, 0.02], dtype=torch.float64)
    noisy = track(curve + deviations * errors(5000, 1.0, seed=4), frames)
    # The median of 5,000 has a standard error of 1.2 %, and the curve bends by 50 / 200^2 / 2 = 0.6 mm a frame.
    assert position_noise(noisy) == pytest.approx(float(deviations.norm()), rel=0.05)
    noisy.world_from_object[::10, :3, 3] += 100.0
    # Three in ten comparisons have a stray: the median is then the 71 % quantile of the rest, 1.06 / 0.67 of it.
    assert position_noise(noisy) == pytest.approx(1.57 * float(deviations.norm()), rel=0.05)


def test_few_boxes():
    assert displacement(track(along_x(torch.tensor([5.0])))) == 0.0
    assert displacement(track(along_x(torch.tensor([5.0, 9.0])))) == 4.0
    assert displacement(track(along_x(torch.tensor([5.0, 7.0, 9.0])))) == 4.0
    assert displacement(track(along_x(torch.tensor([5.0, 5.0, 9.0])))) == 0.0  # one of three is no majority
    assert displacement(track(along_x(torch.tensor([0.0, 0.0, 0.0])))) == 0.0


def test_boxes_have_the_times_of_their_stamps():
    """At constant speed, boxes that are unevenly spaced in time show no noise."""
    times = torch.tensor([0.0, 0.1, 0.4, 0.5, 1.0], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 0, 3] = 20 * times
    even = Track("car", "Car", torch.arange(5), poses, torch.ones(3))
    assert position_noise(replace(even, times=times)) < 1e-12
    assert position_noise(even) > 0.1
