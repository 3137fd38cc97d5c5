"""Which returns are the street's, which an object's, and which a frame sees."""

import math
import weakref
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, as_frames
from sparsestreet.training.moved_views import MovedViews
from sparsestreet.training.moved_views.returns import StreetReturns, collect
from sparsestreet.types import Frame, Sweep, Track, View
from tests.training.stubs import frame_at

SETTINGS = MovedViews(tolerance=0.1)
GAIN = torch.tensor([1.25, 1.0, 0.8])


def gain(view: View) -> Tensor:
    """Another one for each image."""
    return GAIN ** (1 + view.indices[0])


HIDDEN = [0.05, 0.0, 8.0]
"""Behind the return of the car."""
STREET, CAR, ROAD, PERSON, UNSEEN = (
    [4.0, 0.5, 9.0],
    [0.0, 0.0, 6.0],
    [0.5, 0.0, 5.35],
    [-3.0, 0.0, 7.0],
    [0.0, 0.0, -5.0],
)


def track(name: str, at: list[float], size: list[float]) -> Track:
    """At frames 0 and 2. Its box stands along z: returns at a smaller z lie lower in it."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[:, :3, 3] = torch.tensor(at, dtype=torch.float64)
    return Track(name, name, torch.tensor([0, 2]), poses, torch.tensor(size))


CAR_TRACK, PERSON_TRACK = track("car", CAR, [4.0, 2.0, 1.5]), track("person", PERSON, [1.0, 1.0, 2.0])


def sweep(index: int) -> Sweep:
    points = torch.tensor([STREET, CAR, ROAD, PERSON, UNSEEN])
    return Sweep(index, index / 4, points, torch.zeros(5, 3), torch.ones(5, dtype=torch.bool))


@pytest.fixture(scope="module")
def found() -> StreetReturns:
    frames = as_frames([frame_at(index) for index in (0, 2, 4)])
    sweeps = Sweeps.of(tuple(sweep(index) for index in (0, 2, 4)))
    return collect(sweeps, frames, [CAR_TRACK, PERSON_TRACK], [CAR_TRACK], SETTINGS, 0, gain)


def test_the_street_is_what_lies_in_no_moving_box(found):
    assert (found.frames, found.starts) == ((0, 2, 4), (0, 1, 2, 6))
    assert torch.equal(found.street.points[:2], torch.tensor([STREET, STREET]))
    # At frame 4 there are no boxes; what no camera sees has no color.
    assert sorted(found.street.points[2:].tolist()) == sorted(torch.tensor([STREET, CAR, ROAD, PERSON]).tolist())


def test_objects_of_fixed_shape_without_the_road_below_them(found):
    assert found.objects[0].points.tolist() == [CAR]
    assert not len(found.objects[4])
    assert [len(found.boxes(frame, frame / 4)) for frame in (0, 1, 2, 4)] == [2, 0, 2, 0]


def test_colors_are_those_of_the_frames_own_image(found):
    frame = frame_at(2)
    positions = frame.camera.intrinsics @ torch.tensor(STREET)
    column, line = (positions[:2] / positions[2]).long().tolist()
    torch.testing.assert_close(found.street.colors.values[1], frame.image[line, column] / 255 / gain(frame))


def test_weights_are_of_the_images_before_and_after(found):
    """Images are random: a color is found again by chance only."""
    assert (found.street.weights < 1).all()
    assert found.agreement() < 0.5


def test_a_frame_sees_the_sweeps_around_it(found):
    assert found.around(2, 0) == slice(1, 2)
    assert found.around(2, 1) == slice(1, 2)
    assert found.around(2, 2) == slice(0, 6)
    assert found.around(3, 1) == slice(1, 6)
    assert found.around(9, 2) == slice(6, 6)


def test_an_objects_hidden_returns_have_no_color():
    points = torch.tensor([CAR, HIDDEN])
    sweeps = Sweeps.of((Sweep(0, 0.0, points, torch.zeros(2, 3), torch.ones(2, dtype=torch.bool)),))
    long = track("truck", CAR, [4.0, 4.0, 8.0])
    found = collect(sweeps, as_frames([frame_at(0)]), [long], [long], SETTINGS, 0, gain)
    assert found.objects[0].points.tolist() == [CAR]


def test_images_of_the_nearest_instants_weigh():
    """One gray that agrees at the next instant before or after, and black images elsewhere."""
    gray, black = (torch.full((16, 32, 3), value, dtype=torch.uint8) for value in (100, 0))
    point = Sweep(4, 1.0, torch.tensor([STREET]), torch.zeros(1, 3), torch.ones(1, dtype=torch.bool))
    for agreeing, weight in ((3, 1.0), (5, 1.0), (2, math.exp(-1000 / 255)), (7, math.exp(-1000 / 255))):
        frames = [replace(frame_at(0), frame_index=i, image=gray if i in (4, agreeing) else black) for i in range(2, 8)]
        found = collect(Sweeps.of((point,)), as_frames(frames), [], [], SETTINGS, 0, lambda view: torch.ones(3))
        assert found.street.weights.tolist() == [pytest.approx(weight, rel=1e-5)]


def test_each_image_is_read_once_and_few_are_in_memory():
    """Of three instants: its own, and those before and after."""
    read, alive, most = [], weakref.WeakSet(), []

    def load(index: int) -> Frame:
        frame = frame_at(index % 5)
        read.append(index)
        alive.add(frame.image)
        most.append(len(alive))
        return replace(frame, frame_index=index)

    frames = Frames(
        [replace(frame_at(0), frame_index=index) for index in range(9)], lambda view: load(view.frame_index)
    )
    collect(Sweeps.of(tuple(sweep(index) for index in range(9))), frames, [], [], SETTINGS, 0, gain)
    assert sorted(read) == list(range(9))
    assert max(most) <= 4  # the one that makes way goes when the next is there


def test_a_sweep_keeps_no_more_than_it_may():
    frames, sweeps = as_frames([frame_at(4)]), Sweeps.of((sweep(4),))
    settings = MovedViews(returns_per_sweep=2)
    kept = [collect(sweeps, frames, [], [], settings, seed, gain).street for seed in (0, 0, 1, 2, 3)]
    assert {len(street) for street in kept} == {2}
    assert torch.equal(kept[0].points, kept[1].points)
    assert any(not torch.equal(kept[0].points, street.points) for street in kept[2:])
    assert kept[0].weights.tolist() == [1, 1]  # there is no other image


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"every": 0}, "every"), ({"sideways": 0.0}, "sideways"), ({"color_weight": -1.0}, "color_weight"),
     ({"tolerance": float("nan")}, "tolerance"), ({"start": 0.5, "stop": 0.4}, "start <= stop")],
)  # fmt: skip
def test_settings_that_cannot_be(wrong, said):
    with pytest.raises(ValueError, match=said):
        MovedViews(**wrong)


def test_objects_are_where_they_are_when_the_image_is_taken():
    """A car drives 2 m to the right from frame 0 to frame 2. The image of frame 0 is taken at half of that."""
    there = [CAR[0] + 2.0, *CAR[1:]]
    car = track("car", CAR, [1.0, 1.0, 1.5])
    poses = car.world_from_object.clone()
    poses[1, :3, 3] = torch.tensor(there, dtype=torch.float64)
    car = replace(car, world_from_object=poses, times=torch.tensor([0.0, 0.4], dtype=torch.float64))
    points = torch.tensor([CAR, STREET])
    sweeps = Sweeps.of((Sweep(0, 0.0, points, torch.zeros(2, 3), torch.ones(2, dtype=torch.bool)),))
    frame = replace(frame_at(0), time=0.2)
    found = collect(sweeps, as_frames([frame]), [car], [car], SETTINGS, 0, gain)
    halfway = torch.tensor([[CAR[0] + 1.0, *CAR[1:]]])
    assert torch.equal(found.objects_at(0, 0.0).points, torch.tensor([CAR]))
    torch.testing.assert_close(found.objects_at(0, 0.2).points, halfway)
    assert not len(found.objects_at(3, 0.2))
    position = frame.camera.intrinsics @ halfway[0]
    column, line = (position[:2] / position[2]).long().tolist()
    torch.testing.assert_close(found.objects[0].colors.values[0], frame.image[line, column] / 255 / gain(frame))
    ((pose, _),) = found.boxes(0, 0.2)
    torch.testing.assert_close(pose[:3, 3], halfway[0].double())
    assert found.street.points.tolist() == [STREET]
