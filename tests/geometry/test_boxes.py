"""Boxes at the times of views, and points that boxes carry."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.boxes import CarriedPoints, box_at, view_lag, without_frames
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
