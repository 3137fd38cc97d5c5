"""Paths from files: where the cameras are, what they see, and one sentence about what is wrong."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.export.path_file import PathFile, read_path
from sparsestreet.geometry.transforms import inverse
from tests.export.street import street_views

SECONDS = 4.0
LIKE = street_views(cameras=(0,))[0]


def read(said: Any, tmp_path: Path, fps: float = 10.0) -> PathFile:
    path = tmp_path / "path.json"
    path.write_text(said if isinstance(said, str) else json.dumps(said))
    return read_path(path, LIKE, SECONDS, fps)


def pose(x: float = 0.0, yaw: float = 0.0) -> list[list[float]]:
    """A camera that looks along +y, turned about its own y, which points down."""
    turn = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    axes = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    full = np.eye(4)
    full[:3, :3] = axes @ turn
    full[0, 3] = x
    return full.tolist()


def test_the_recorded_poses_are_the_recorded_views(tmp_path):
    views = street_views(cameras=(0,))
    poses = [
        {
            "seconds": SECONDS * view.time,
            "world_from_camera": inverse(view.camera.camera_from_world.double()).tolist(),
        }
        for view in views
    ]
    found = read({"poses": poses}, tmp_path)
    assert found.fps is None
    for (view,), recorded in zip(found.path, views, strict=True):
        torch.testing.assert_close(view.camera.camera_from_world, recorded.camera.camera_from_world, rtol=0, atol=2e-6)
        assert torch.equal(view.camera.intrinsics, recorded.camera.intrinsics)
        assert (view.camera.width, view.time, view.frame_index) == (recorded.camera.width, recorded.time, None)


def test_a_pose_may_have_its_own_lens_or_that_of_the_file(tmp_path):
    entry = {"seconds": 1.0, "world_from_camera": pose()}
    own = entry | {"intrinsics": [50, 60, 32, 18], "width": 64, "height": 36}
    found = read({"poses": [entry, own], "intrinsics": [10, 10, 8, 4], "width": 16, "height": 8}, tmp_path)
    first, second = (rig[0].camera for rig in found.path)
    assert (first.width, first.height, first.intrinsics[0, 0].item()) == (16, 8, 10.0)
    assert (second.width, second.height) == (64, 36)
    assert second.intrinsics.tolist() == [[50, 0, 32], [0, 60, 18], [0, 0, 1]]


def test_keyframes_are_met_and_joined_smoothly(tmp_path):
    keys = [
        {"seconds": at, "world_from_camera": pose(x, yaw)}
        for at, x, yaw in ((0.0, 0.0, 0.0), (1.0, 2.0, 0.1), (3.0, 6.0, 0.3))
    ]
    found = read({"keyframes": keys}, tmp_path, fps=5.0)
    assert [rig[0].time for rig in found.path] == pytest.approx([index / 5 / SECONDS for index in range(16)])
    for index, (view,) in enumerate(found.path):
        # Keyframes on a line at an even speed, with an even turn: so is the spline.
        expected = np.array(pose(2.0 * index / 5, 0.1 * index / 5))
        np.testing.assert_allclose(inverse(view.camera.camera_from_world.double()).numpy(), expected, atol=1e-6)


def test_a_bend_has_no_corner(tmp_path):
    keys = [{"seconds": at, "world_from_camera": pose(x)} for at, x in ((0.0, 0.0), (1.0, 1.0), (2.0, 0.0))]
    found = read({"keyframes": keys}, tmp_path, fps=50.0)
    x = np.array([float(view.camera.position[0]) for (view,) in found.path])
    assert x[50] == pytest.approx(1.0, abs=1e-5)
    # Straight pieces would stop at 1 with a jump of the step from +0.02 to -0.02.
    assert np.abs(np.diff(x, 2)).max() < 0.002


def test_nerfstudios_axes_field_of_view_and_time(tmp_path):
    """OpenGL's camera of an OpenCV pose has y and z the other way."""
    flipped = np.array(pose(3.0)) @ np.diag([1.0, -1, -1, 1])
    entry = {"camera_to_world": flipped.flatten().tolist(), "fov": 90.0, "aspect": 2.0}
    said = {
        "camera_type": "perspective", "render_height": 100, "render_width": 200, "fps": 2.0, "seconds": 1.0,
        "camera_path": [entry, entry, entry | {"render_time": 0.75}],
    }  # fmt: skip
    found = read(said, tmp_path)
    assert found.fps == 2.0
    cameras = [rig[0].camera for rig in found.path]
    np.testing.assert_allclose(inverse(cameras[0].camera_from_world.double()).numpy(), np.array(pose(3.0)), atol=1e-6)
    # tan(90 / 2) = 1: half the height.
    assert cameras[0].intrinsics.tolist() == [[50, 0, 100], [0, 50, 50], [0, 0, 1]]
    assert [rig[0].time for rig in found.path] == pytest.approx([0.0, 0.5 / SECONDS, 0.75])


ENTRY = {"seconds": 0.0, "world_from_camera": pose()}
SCALED = (2 * np.array(pose())).tolist()


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ("{", "is no JSON"),
        ({"places": []}, "has a list of one of poses, keyframes, camera_path"),
        ({"poses": []}, "and something in it"),
        ({"poses": [{"seconds": 0}]}, r"poses\[0\] lacks world_from_camera"),
        ({"poses": [ENTRY | {"second": 0}]}, r"poses\[0\] has the keys height, intrinsics"),
        ({"poses": [ENTRY | {"seconds": 9}]}, "the log lasts from 0 to 4 seconds, got a pose at 9"),
        ({"poses": [ENTRY | {"seconds": None}]}, "seconds has one finite numbers, got None"),
        ({"poses": [ENTRY | {"world_from_camera": SCALED}]}, "it may be scaled"),
        ({"poses": [ENTRY | {"world_from_camera": [1, 2]}]}, "has 4 x 4 finite numbers"),
        ({"poses": [ENTRY | {"width": 8}]}, "width, height and intrinsics go together"),
        ({"poses": [ENTRY | {"intrinsics": [0, 1, 1, 1]}]}, "focal lengths are above 0"),
        (
            {"poses": [ENTRY | {"width": 10**6, "height": 1, "intrinsics": [1, 1, 1, 1]}]},
            "are pixels, 1 to 16384, got 1000000",
        ),
        ({"keyframes": [ENTRY]}, "two or more at increasing seconds"),
        ({"keyframes": [ENTRY, ENTRY]}, "two or more at increasing seconds"),
        ({"camera_path": [{}], "render_width": 8, "render_height": 8}, r"camera_path\[0\] has camera_to_world and fov"),
        ({"camera_path": [{}]}, "render_width and height are pixels"),
        ({"camera_path": [{}], "camera_type": "equirectangular"}, "only perspective cameras"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(said, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence) as found:
        read(said, tmp_path)
    assert "path.json" in str(found.value)


def test_there_must_be_a_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no path at"):
        read_path(tmp_path / "none.json", LIKE, SECONDS, 10.0)
