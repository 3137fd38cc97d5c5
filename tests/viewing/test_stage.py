"""What a window shows: the scene at the time of the clock, as it is edited, from where the window looks."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sparsestreet.geometry.cameras import inverse
from sparsestreet.viewing.edit_state import EditState, Offset
from sparsestreet.viewing.object_panel import eye_of, matrix, wxyz_of
from sparsestreet.viewing.stage import Eye, RecordedCamera, Stage
from tests.export.street import stored_street, street_views

SECONDS = 4.0


@pytest.fixture
def stage() -> Stage:
    stored = stored_street()
    return Stage(stored, street_views(), EditState(stored.scene, {}, SECONDS, lambda path: (stored, 1.0)))


def recorded_eye(frame: int = 2) -> Eye:
    camera = street_views(cameras=(0,))[frame].camera
    pose = inverse(camera.camera_from_world.double()).numpy()
    return Eye(pose, 2 * math.atan(16 / float(camera.intrinsics[1, 1])), camera.width, camera.height)


def test_a_recorded_camera_shows_the_recorded_view(stage):
    stage.seek(2.0)
    view = street_views(cameras=(0,))[2]
    expected = (stored_street().render(view).rgb.clamp(0, 1) * 255).round().byte().numpy()
    # The pose goes through its inverse twice.
    assert np.abs(stage.picture(recorded_eye(), 48, 32).astype(int) - expected).max() <= 1
    assert stage.picture(recorded_eye(), 24, 16).shape == (16, 24, 3)


def test_views_of_a_part_of_the_log_have_a_clock_of_their_own():
    """Of times 0.25 to 0.75: half of the log's seconds, and the first second shows what the camera saw then."""
    stored = stored_street()
    views = [view for view in street_views(cameras=(0,)) if 0.25 <= view.time <= 0.75]
    stage = Stage(stored, views, EditState(stored.scene, {}, SECONDS, lambda path: (stored, 1.0)))
    assert (stage.duration, stage.time) == (SECONDS / 2, 0.25)
    stage.seek(1.0)
    expected = (stored.render(views[1]).rgb.clamp(0, 1) * 255).round().byte().numpy()
    assert stage.time == 0.5
    assert np.abs(stage.picture(recorded_eye(), 48, 32).astype(int) - expected).max() <= 1  # as above
    stage.seek(9.0)
    assert stage.time == 0.75


def test_edits_are_seen(stage):
    before = stage.picture(recorded_eye(), 48, 32)
    version = stage.version
    stage.edits.hide("car", True)
    stage.changed()
    assert stage.version > version
    assert not np.array_equal(stage.picture(recorded_eye(), 48, 32), before)
    stage.edits.hide("car", False)
    assert np.array_equal(stage.picture(recorded_eye(), 48, 32), before)
    stage.edits.move("car", Offset(up=50.0))
    assert not np.array_equal(stage.picture(recorded_eye(), 48, 32), before)


def test_the_clock_runs_at_the_logs_speed_and_starts_again(stage):
    assert stage.duration == SECONDS
    stage.tick(10.0)
    assert stage.seconds == 0
    stage.play(True)
    stage.tick(20.0)
    stage.tick(21.5)
    assert (stage.seconds, stage.time) == (1.5, 1.5 / SECONDS)
    stage.tick(24.6)
    assert stage.seconds == 0
    stage.play(False)
    version = stage.version
    stage.tick(30.0)
    assert (stage.seconds, stage.version) == (0, version)
    stage.seek(99.0)
    assert stage.seconds == SECONDS


def test_between_two_views_a_camera_is_in_the_middle():
    views = street_views(cameras=(0,))
    camera = RecordedCamera(views)
    # 1 m and 3 degrees a frame.
    middle = camera.at(0.375)
    np.testing.assert_allclose(middle[:3, 3], [1.5, 0.15, 1.5], atol=1e-5)
    np.testing.assert_allclose(middle[:2, 2], [math.cos(math.radians(4.5)), math.sin(math.radians(4.5))], atol=1e-6)
    np.testing.assert_allclose(camera.at(-1.0), camera.at(0.0))
    assert camera.fov == pytest.approx(2 * math.atan(16 / 24))


def test_poses_go_to_the_window_and_back():
    pose = recorded_eye(3).world_from_camera
    np.testing.assert_allclose(matrix(wxyz_of(pose), pose[:3, 3]), pose, atol=1e-6)  # the views are float32
    assert recorded_eye(3).same(recorded_eye(3))
    assert not recorded_eye(3).same(recorded_eye(2))


@pytest.mark.parametrize(
    "wrong",
    [{"fov": 0.0}, {"fov": 4.0}, {"fov": math.nan}, {"image_width": 0}, {"image_height": 10**6},
     {"wxyz": np.zeros(4)}, {"position": np.array([0, math.inf, 0])}],
)  # fmt: skip
def test_what_is_no_camera_is_not_rendered(wrong):
    right = {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.zeros(3), "fov": 1.0, "image_width": 9, "image_height": 8}
    assert eye_of(SimpleNamespace(**right)).same(Eye(np.eye(4), 1.0, 9, 8))
    assert eye_of(SimpleNamespace(**right | wrong)) is None


def test_a_camera_sees_the_whole_window():
    eye = recorded_eye()
    large, small = eye.camera(480, 320), eye.camera(48, 32)
    torch.testing.assert_close(large.intrinsics[:2], 10 * small.intrinsics[:2])
