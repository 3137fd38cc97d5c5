"""Splits and the size of the scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sparsestreet.data.lazy import as_frames
from sparsestreet.data.log import split
from sparsestreet.types import SparsePoints, Sweep, Track
from tests.data.plan import make_log


def sweep(points: torch.Tensor, colored: torch.Tensor) -> Sweep:
    return Sweep(0, 0.0, points, torch.full_like(points, 0.5), colored)


@pytest.mark.lengthy
@settings(deadline=None)  # the first example pays for what is built once
@given(st.integers(2, 30), st.integers(1, 3), st.integers(2, 12), st.data())
def test_a_split_takes_every_frame_once_and_all_cameras_of_an_instant_together(num_frames, num_cameras, stride, data):
    offset = data.draw(st.integers(0, min(stride, num_frames - 1)))
    log = make_log(num_frames, num_cameras)
    parts = split(log, stride=stride, offset=offset)
    held_out = [frame.frame_index for frame in parts.held_out]
    assert held_out == [index for index in range(offset, num_frames, stride) for _ in range(num_cameras)]
    order = {id(frame): place for place, frame in enumerate(log.frames)}
    places = [[order[id(frame)] for frame in part] for part in (parts.train, parts.held_out)]
    assert sorted(places[0] + places[1]) == list(range(len(log.frames)))
    assert all(place == sorted(place) for place in places)
    assert not set(held_out) & {frame.frame_index for frame in parts.train}


def test_stride_zero_holds_out_nothing():
    log = make_log(3)
    assert split(log, stride=0, offset=7).train is log.frames
    assert split(log, stride=0).train is log.frames
    assert len(split(log, stride=0).held_out) == 0


def test_a_camera_is_held_out_at_all_frames_and_its_instants_are_trained_on():
    log = replace(make_log(8, 2), camera_names=("front", "rear"))
    parts = split(log, stride=0, cameras=["rear"])
    assert {view.camera_index for view in parts.train.views} == {0}
    assert [view.indices for view in parts.held_out.views] == [(index, 1) for index in range(8)]
    assert parts.held_out_indices == frozenset()


def test_a_camera_and_instants_are_held_out_together():
    parts = split(make_log(8, 2), stride=4, offset=1, cameras=[0])
    assert [view.indices for view in parts.train.views] == [(index, 1) for index in (0, 2, 3, 4, 6, 7)]
    assert len(parts.held_out) == 10
    assert parts.held_out_indices == {1, 5}


@pytest.mark.parametrize(("cameras", "said"), [(["rear"], r"\['rear'\].* are 0, 1"), ([0, 1], "leave one to train on")])
def test_a_camera_that_cannot_be_held_out(cameras, said):
    with pytest.raises(ValueError, match=said):
        split(make_log(8, 2), cameras=cameras)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"stride": 1, "offset": 0}, "holds out all of 12 frames"),
        ({"stride": 5, "offset": 6}, "offset <= stride"),
        ({"stride": 5, "offset": -1}, "offset <= stride"),
        ({"stride": -2, "offset": 0}, "offset <= stride"),
        ({"stride": 20, "offset": 12}, "nothing would be held out"),
    ],
)
def test_a_split_that_leaves_one_side_empty_is_an_error(choice, message):
    with pytest.raises(ValueError, match=message):
        split(make_log(12), **choice)


def test_the_radius_follows_the_quantiles_of_what_cameras_see():
    """1001 points evenly spaced over 0 .. 100 m in x: the quantiles are 2 and 98 m, a stray point moves neither."""
    points = torch.zeros(1003, 3)
    points[:1001, 0] = torch.linspace(0, 100, 1001)
    points[1001:, 1] = 5e3  # no camera sees these
    colored = torch.ones(1003, dtype=torch.bool)
    colored[1001:] = False
    log = make_log(num_frames=3, num_cameras=1, sweeps=(sweep(points, colored),))
    assert log.radius == pytest.approx(1.1 * 98 / 2, rel=1e-6)  # from camera 0 at x = 0 to the upper quantile
    assert torch.allclose(log.center, torch.tensor([49.0, 0, 0]), atol=1e-5)


def test_the_box_reaches_around_the_cameras():
    points = torch.zeros(10, 3)
    log = make_log(num_frames=41, num_cameras=1, sweeps=(sweep(points, torch.zeros(10, dtype=torch.bool)),))
    assert log.radius == pytest.approx(1.1 * 40 / 2)
    assert torch.allclose(log.center, torch.tensor([20.0, 0, 0]))


def test_along_the_first_pose_the_size_is_the_same_wherever_the_street_leads():
    """80 m ahead, 20 m across, 3 m high: DriveStudio's box ends 20 m up and leaves the cameras out."""
    forward = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (4000, 3))) * torch.tensor([40.0, 10.0, 1.5])
    low, high = np.quantile(forward.numpy(), (0.02, 0.98), axis=0)
    middle = torch.from_numpy((low + np.array((high[0], high[1], 20.0))) / 2)
    for degrees in (0, 45, 130):
        turn = torch.eye(3, dtype=torch.float64)
        sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        turn[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]])
        points = (forward @ turn.T).float()
        log = make_log(num_frames=300, num_cameras=1, sweeps=(sweep(points, torch.ones(4000, dtype=torch.bool)),))
        along = replace(log, first_axes=turn)
        assert along.radius == pytest.approx(1.1 * (high[0] - low[0]) / 2, rel=1e-6)
        assert torch.allclose(along.center, (turn @ middle).float(), atol=1e-4)
        # Its corners are the corners of [-1, 1], each side by its own length.
        corners = torch.from_numpy(np.stack((low, (*high[:2], 20.0)))) @ turn.T
        box = along.box_from_world.double()
        assert torch.allclose(corners @ box[:, :3].T + box[:, 3], torch.tensor([[-1.0], [1.0]]).double(), atol=1e-5)
        # Around 300 m of cameras.
        assert log.radius > 150


def test_a_log_of_one_height_has_a_box_all_the_same():
    flat = torch.tensor([[0.0, 0, 5], [100, 0, 5], [0, 10, 5], [100, 10, 5]]).repeat(50, 1)
    log = make_log(num_frames=2, num_cameras=1, sweeps=(sweep(flat, torch.ones(200, dtype=torch.bool)),))
    box = replace(log, first_axes=torch.eye(3, dtype=torch.float64)[[0, 2, 1]]).box_from_world
    assert box.isfinite().all()
    assert float(box[1, :3].norm()) == pytest.approx(2 / (0.01 * 100))  # the flat axis counts as 1 m


def test_along_the_first_pose_without_lidar():
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    log = make_log(num_frames=3, num_cameras=1)
    along = replace(log, first_axes=turn)
    assert along.radius == pytest.approx(log.radius)  # a quarter turn
    assert torch.allclose(along.center, log.center, atol=1e-5)


def test_without_lidar_cameras_see_fifty_metres_ahead():
    log = make_log(num_frames=3, num_cameras=1)
    assert log.radius == pytest.approx(1.1 * 50 / 2)  # they look along z
    assert torch.allclose(log.center, torch.tensor([1.0, 0, 25]))
    along_x = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    frame = replace(log.frames[0], camera=replace(log.frames[0].camera, camera_from_world=along_x))
    assert torch.allclose(replace(log, frames=as_frames([frame])).center, torch.tensor([25.0, 0, 0]))


def test_without_lidar_the_box_reaches_around_the_points_that_came_with_the_log():
    points = torch.from_numpy(np.random.default_rng(0).uniform(-90, 90, (5000, 3)).astype(np.float32))
    sparse = SparsePoints(points, torch.zeros_like(points))
    log = replace(make_log(num_frames=1, num_cameras=1), sparse_points=lambda: sparse)
    low, high = np.quantile(points.numpy(), (0.02, 0.98), axis=0)
    assert log.radius == pytest.approx(1.1 * (high - low).max() / 2)
    np.testing.assert_allclose(log.center.numpy(), (low + high) / 2, atol=1e-5)
    assert not len(log.sweeps)
    # Returns come before them.
    returns = sweep(torch.zeros(10, 3), torch.ones(10, dtype=torch.bool))
    with_lidar = make_log(num_frames=41, num_cameras=1, sweeps=(returns,))
    assert replace(with_lidar, sparse_points=lambda: sparse).radius == with_lidar.radius


def test_very_many_points_are_thinned_evenly():
    points = torch.from_numpy(np.random.default_rng(0).uniform(-50, 50, (2_500_000, 3)).astype(np.float32))
    log = make_log(num_frames=1, num_cameras=1, sweeps=(sweep(points, torch.ones(2_500_000, dtype=torch.bool)),))
    # The 2 % quantile of 8e5 samples of a 100 m interval scatters by 100 * sqrt(0.02 * 0.98 / 8e5) = 0.016 m.
    assert log.radius == pytest.approx(1.1 * 96 / 2, abs=0.1)


def test_points_are_thinned_alike_in_however_many_sweeps_they_lie():
    """Every second of 1.1 million is taken; a part behind an odd number of points must not start anew."""
    points = torch.from_numpy(np.random.default_rng(1).normal(0, 50, (1_100_000, 3)).astype(np.float32))
    colored = torch.ones(1_100_000, dtype=torch.bool)
    whole = make_log(num_frames=1, num_cameras=1, sweeps=(sweep(points, colored),))
    parts = torch.split(points, [1, 600_000, 0, 300_001, 199_998])
    sweeps = tuple(Sweep(index, 0.0, part, part, colored[: len(part)]) for index, part in enumerate(parts))
    log = make_log(num_frames=1, num_cameras=1, sweeps=sweeps)
    assert log.radius == whole.radius
    assert torch.equal(log.center, whole.center)


def test_where_no_camera_sees_a_point_all_of_them_count():
    points = torch.tensor([[0.0, 0, 0], [100.0, 0, 0]]).repeat(50, 1)
    log = make_log(num_frames=1, num_cameras=1, sweeps=(sweep(points, torch.zeros(100, dtype=torch.bool)),))
    assert log.radius == pytest.approx(1.1 * 50)


def test_a_frame_has_the_stamp_of_its_first_image():
    """The second camera fires 5 ns before the first."""
    log = make_log(3, 2)
    stamped = [
        replace(frame, stamp=100 + 10 * index - 5 * camera, seconds=index - camera / 2)
        for frame in log.frames
        for index, camera in [frame.indices]
    ]
    log = replace(log, frames=as_frames(stamped))
    assert log.stamps == {0: 95, 1: 105, 2: 115}
    assert log.seconds == {0: -0.5, 1: 0.5, 2: 1.5}


def test_two_objects_of_one_name_are_no_log():
    log = make_log(3)
    track = Track("a", "car", torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None], torch.ones(3))
    with pytest.raises(ValueError, match="'a' stands twice: rename one of them"):
        replace(log, tracks=(track, replace(track, name="b"), track))
