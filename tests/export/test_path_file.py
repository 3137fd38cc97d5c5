"""Paths from files: where the cameras are, what they see, and one sentence about what is wrong."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sparsestreet.export.path_file import PathFile, read_path
from sparsestreet.geometry.cameras import inverse
from tests.export.street import street_views
from tests.typed import there

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


def nerfstudio(**said: Any) -> dict[str, Any]:
    """A path of three poses in the form that nerfstudio's viewers write; ``said`` is what they differ in."""
    flipped = (np.array(pose(3.0, 0.2)) @ np.diag([1.0, -1, -1, 1])).flatten().tolist()
    entry = {"camera_to_world": flipped, "fov": 50.0, "aspect": 1.0}
    rest = {"render_height": 24, "render_width": 33, "fps": 10, "seconds": 0.3, "is_cycle": False, "crop": None}
    return {"camera_type": "perspective", "smoothness_value": 0.5, "camera_path": [entry] * 3} | rest | said


KEY = {"fov": 50, "aspect": 1.5}
COLUMNS = np.array(pose(3.0)).T.flatten().tolist()
IN_JAVASCRIPT = {"keyframes": [KEY | {"matrix": json.dumps(COLUMNS), "properties": '[["FOV",50],["TIME",0]]'}] * 2}
IN_VISER = {
    "default_fov": 75.0, "default_transition_sec": 2.0, "render_height": 24.0, "render_width": 33.0, "fps": 10.0,
    "keyframes": [
        KEY | {"matrix": COLUMNS, "override_transition_enabled": False, "override_transition_sec": None}
    ] * 2,
}  # fmt: skip


@pytest.mark.parametrize(
    "own", [{}, IN_JAVASCRIPT, IN_VISER, {"keyframes": []}], ids=["alone", "three.js", "viser", "-"]
)
def test_files_of_nerfstudios_viewers_are_read_by_their_path(own, tmp_path):
    """The viewer in three.js puts JSON into the JSON, that of viser whole floats for sizes; both add keyframes."""
    found = read(nerfstudio(**own), tmp_path)
    assert (len(found.path), found.fps, found.note) == (3, 10.0, None)
    camera = found.path[0][0].camera
    assert (camera.width, camera.height) == (33, 24)
    assert type(camera.width) is int
    np.testing.assert_allclose(inverse(camera.camera_from_world.double()).numpy(), pose(3.0, 0.2), atol=1e-6)


def test_rows_of_a_pose_may_be_nested_and_a_crop_without_effect_is_said(tmp_path):
    entry = nerfstudio()["camera_path"][0]
    nested = entry | {"camera_to_world": np.reshape(entry["camera_to_world"], (4, 4)).tolist()}
    found = read(nerfstudio(camera_path=[nested], crop={"crop_scale": [1, 1, 1]}), tmp_path)
    assert torch.equal(
        found.path[0][0].camera.camera_from_world, read(nerfstudio(), tmp_path).path[0][0].camera.camera_from_world
    )
    assert "crop" in there(found.note)


ENTRY = {"seconds": 0.0, "world_from_camera": pose()}
SCALED = (2 * np.array(pose())).tolist()


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ("{", "is no JSON"),
        ({"places": []}, "has a list of one of camera_path, poses, keyframes"),
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
        (nerfstudio(render_width=32.5), "are pixels, 1 to 16384, got 32.5 and 24"),
        (nerfstudio(render_width=True), "are pixels, 1 to 16384, got True"),
        (nerfstudio(fps=1e9), "fps is above 0 and at most 1000, got 1e\\+09"),
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
