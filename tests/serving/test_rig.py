"""The vehicle of a run: from what training kept, from a mount, with and without a clock."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sparsestreet.geometry.cameras import inverse
from sparsestreet.records.run import RIG, RigRecord
from sparsestreet.scene.views import RecordedViews
from sparsestreet.serving.rig import rig_of
from tests.export.street import street_views
from tests.serving.street import START_US, STEP_US, at, timed_views, world_from_camera

TIMED = RecordedViews(tuple(timed_views()), (), 4.0)


def rows(pose: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, pose.tolist()))


def record(**changes) -> RigRecord:
    """A vehicle that drives straight ahead, seen at instants of its own, 10 ms after the frames."""
    said = {
        "camera_names": ("front", "left", "right", "rear"),
        "dataset_from_world": rows(at(1000.0, 2000.0, 30.0)),
        "world_from_vehicle": tuple(rows(at(frame + 0.04, -0.5, 0.1)) for frame in range(5)),
        "vehicle_stamps": tuple(1000 * (START_US + STEP_US * frame + 10_000) for frame in range(5)),
    }
    return RigRecord(**(said | changes))


def test_the_recorded_vehicle_is_where_it_was_at_its_own_stamps(tmp_path):
    RIG.write(tmp_path, record())
    rig = rig_of(TIMED, RIG.read(tmp_path))
    assert [camera.name for camera in rig.cameras] == ["front", "left", "right", "rear"]
    # 10 ms after the frame of 0.25 s; then half a frame on.
    assert np.allclose(rig.at(0.26), at(1.04, -0.5, 0.1))
    assert np.allclose(rig.at(0.385), at(1.54, -0.5, 0.1))
    assert np.array_equal(rig.at(0.0), at(0.04, -0.5, 0.1))  # before its first pose
    assert np.array_equal(rig.dataset_from_world, at(1000.0, 2000.0, 30.0))
    # Frame 0: the vehicle stands at its first pose then.
    mounted = rig.camera("left").rig_from_camera
    assert np.allclose(rig.at(0.0) @ mounted, world_from_camera(timed_views()[1].camera), atol=1e-6)


def test_without_stamps_the_poses_are_those_of_the_frames():
    rig = rig_of(TIMED, record(vehicle_stamps=None))
    assert rig.times == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert np.allclose(rig.at(0.5), at(2.04, -0.5, 0.1))


def test_a_mount_puts_the_vehicle_below_its_first_camera_level():
    rig = rig_of(TIMED, None, mount=(1.0, 0.2, 1.3), names=("a", "b", "c", "d"))
    camera, vehicle = world_from_camera(timed_views()[8].camera), rig.at(0.5)
    assert np.allclose((np.linalg.inv(vehicle) @ camera)[:3, 3], [1.0, 0.2, 1.3], atol=1e-6)
    assert np.allclose(vehicle[:3, 2], [0, 0, 1])
    assert np.allclose(vehicle[:3, 0], camera[:3, 2], atol=1e-6)  # the camera looks straight ahead
    assert rig.camera("c").index == 2


def test_a_view_from_a_vehicle_that_stands_elsewhere():
    rig = rig_of(TIMED, record())
    view = rig.view("right", at(7.0, 1.0, 0.0, yaw=0.3), START_US + 500_000)
    assert (view.time, view.camera_index, view.frame_index) == (0.5, 2, None)
    mounted = rig.camera("right").rig_from_camera
    seen_from = inverse(view.camera.camera_from_world.double()).numpy()
    assert np.allclose(seen_from, at(7.0, 1.0, 0.0, yaw=0.3) @ mounted, atol=1e-6)


def test_microseconds_are_those_of_the_log_or_count_from_zero():
    clock = rig_of(TIMED, None).clock
    assert (clock.start, clock.seconds) == (START_US, 1.0)
    assert clock.time(START_US + 500_000) == 0.5
    assert clock.microseconds(0.75) == START_US + 750_000
    plain = RecordedViews(tuple(street_views()), ())
    assert rig_of(plain, None).clock.microseconds(1.0) == 400_000  # 4 steps at 10 frames a second
    assert rig_of(plain, None, frame_rate=2.0).clock.microseconds(1.0) == 2_000_000


def test_the_clock_starts_where_time_does_though_the_first_view_is_late():
    late = [replace(view, time=0.2 + 0.8 * view.time, seconds=0.25 + (view.seconds or 0)) for view in timed_views()]
    clock = rig_of(RecordedViews(tuple(late), (), 4.0), None).clock
    assert clock.seconds == pytest.approx(1.25)
    assert clock.start == START_US - 250_000


def test_what_does_not_fit_is_said():
    with pytest.raises(ValueError, match="a name for each of the 4 cameras, got a, b"):
        rig_of(TIMED, None, names=("a", "b"))
    with pytest.raises(ValueError, match="no camera 'up', only 0, 1, 2, 3"):
        rig_of(TIMED, None).camera("up")
    turn = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
    tilted = [
        replace(view, camera=replace(view.camera, camera_from_world=view.camera.camera_from_world @ turn))
        for view in timed_views()
    ]
    with pytest.raises(ValueError, match="z of the world is not up"):
        rig_of(RecordedViews(tuple(tilted), ()), None)
    with pytest.raises(ValueError, match="each pose has a stamp, got 5 poses and 1 stamps"):
        record(vehicle_stamps=(1,))
