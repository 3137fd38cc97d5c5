"""Boxes at the times of views, and points that boxes carry."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import CarriedPoints, box_at, displacement, position_noise, view_lag, without_frames
from sparsestreet.geometry.quaternions import to_matrix
from sparsestreet.types import BodyPoses, Camera, Track, View
from tests.typed import there


def poses(x: list[float], yaw: list[float]) -> torch.Tensor:
    made = torch.eye(4, dtype=torch.float64).repeat(len(x), 1, 1)
    turn = torch.zeros(len(x), 3, dtype=torch.float64)
    turn[:, 2] = torch.tensor(yaw, dtype=torch.float64)
    made[:, :3, :3] = quat.to_matrix(quat.from_rotation_vector(turn))
    made[:, 0, 3] = torch.tensor(x)
    return made


def car(times: list[float] | None = None) -> Track:
    """At frames 2, 3 and 5; it drives 10 m from the first box to the second, and turns a quarter to the third."""
    at = None if times is None else torch.tensor(times, dtype=torch.float64)
    turns = poses([0.0, 10.0, 10.0], [0.0, 0.0, torch.pi / 2])
    return Track("car", "Car", torch.tensor([2, 3, 5]), turns, torch.tensor([4.0, 2.0, 1.5]), times=at)


TIMES = [0.2, 0.3, 0.5]


@pytest.mark.parametrize(
    ("frame", "time", "x", "degrees"),
    [
        (2, 0.2, 0.0, 0.0),
        (2, 0.25, 5.0, 0.0),  # towards the next
        (3, 0.29, 9.0, 0.0),  # back towards the one before
        (3, 0.35, 10.0, 22.5),  # over a gap
        (2, 0.15, -5.0, 0.0),  # before the first, at its velocity
        (5, 0.55, 10.0, 112.5),  # behind the last
    ],
)
def test_a_box_at_the_time_of_a_view(frame: int, time: float, x: float, degrees: float):
    found = there(box_at(car(TIMES), frame, time))
    expected = poses([x], [degrees * torch.pi / 180])[0]
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)  # rounding of doubles


def test_a_box_of_that_very_time_is_the_annotated_one_bit_for_bit():
    track = car(TIMES)
    # Not to a quaternion and back, which would change the last bits.
    track = replace(track, world_from_object=poses([0.0, 0.1, 0.3], [0.1, 0.77, 0.3]))
    assert torch.equal(there(box_at(track, 3, 0.3)), track.world_from_object[1])
    bare = car()
    assert torch.equal(there(box_at(bare, 3, 0.47)), bare.world_from_object[1])  # a log without a clock knows no other
    only = without_frames([track], frozenset({2, 5}))[0]
    assert torch.equal(there(box_at(only, 3, 0.47)), track.world_from_object[1])


@pytest.mark.parametrize("times", [None, TIMES])
def test_a_frame_without_an_annotation_has_no_box(times: list[float] | None):
    assert box_at(car(times), 4, 0.4) is None


def test_boxes_of_held_out_frames_say_nothing():
    body = BodyPoses(torch.zeros(3, 24, 4), torch.tensor([True, False, True]), torch.zeros(10))
    track = replace(car(TIMES), body=body, span=(0.1, 0.6))
    (left,) = without_frames([track], frozenset({3, 4}))
    assert (left.frames.tolist(), left.span, there(left.body).valid.tolist()) == ([2, 5], (0.1, 0.6), [True, True])
    assert there(box_at(left, 2, 0.25))[0, 3] == pytest.approx(10 / 6)  # now on the way to the third box
    assert without_frames([track, car(TIMES)], frozenset({2, 3, 5})) == ()
    bare = car()
    assert without_frames([bare], frozenset({2, 3, 5})) == (bare,)


CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)


def test_how_far_views_are_from_the_boxes_of_their_frames():
    views = [View(CAMERA, 0.9, 0, 0), View(CAMERA, 0.28, 2, 0), View(CAMERA, 0.27, 3, 1), View(CAMERA, 0.9, 4, 0)]
    assert view_lag([car(), car(TIMES)], views) == pytest.approx(0.08)
    assert view_lag([car()], views) == 0.0
    assert view_lag([], views) == 0.0


POINTS = torch.tensor([[-1.9, 0.9, 0.0], [2.1, 0.0, 0.0], [2.3, 0.0, 0.0], [0.0, 0.0, 5.0]])
"""In the box; just outside of it; farther; above."""


def test_points_in_a_box_go_with_it_and_others_stay():
    carried = CarriedPoints(POINTS, 0.2, 2, [car(TIMES)])
    moved = carried.at(0.25)
    torch.testing.assert_close(moved - POINTS, torch.tensor([[5.0, 0, 0], [5, 0, 0], [0, 0, 0], [0, 0, 0]]))
    turned = CarriedPoints(POINTS + torch.tensor([10.0, 0, 0]), 0.3, 3, [car(TIMES)]).at(0.5)
    torch.testing.assert_close(turned[:1], torch.tensor([[9.1, -1.9, 0.0]]))


def test_a_point_at_a_corner_goes_too_whichever_way_the_box_stands():
    """Turned so that a corner lies farther along x than any side is long."""
    corner = torch.tensor([[1.99, 0.99, 0.74]])
    for yaw in (0.0, -math.atan2(1, 2), 2.0):
        turned = replace(car(TIMES), world_from_object=poses([0.0, 10.0, 10.0], [yaw] * 3))
        turn = turned.world_from_object[0, :3, :3].float()
        found = CarriedPoints(1.05 * corner @ turn.T, 0.2, 2, [turned]).at(0.25)
        torch.testing.assert_close(found, 1.05 * corner @ turn.T + torch.tensor([5.0, 0.0, 0.0]))


def test_at_their_own_time_points_cost_nothing():
    class Untouched(Track):
        @property
        def frames(self):  # pyright: ignore[reportIncompatibleVariableOverride]
            raise AssertionError("a box was asked for")

    carried = CarriedPoints(POINTS, 0.2, 2, [object.__new__(Untouched)])
    assert carried.at(0.2) is POINTS
    assert CarriedPoints(POINTS, 0.2, 2, []).at(0.9) is POINTS
    assert CarriedPoints(POINTS, 0.4, 4, [car(TIMES)]).at(0.9) is POINTS  # no box in this frame


def test_without_a_point_nothing_is_carried():
    assert CarriedPoints(torch.zeros(0, 3), 0.2, 2, [car(TIMES)]).at(0.3).shape == (0, 3)


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
