"""Which lenses are simulated, and where lidar is seen through them."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.geometry.cameras import project
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.rendering import RenderOptions, render
from tests.data.drivestudio.folders import (
    FOCAL,
    HEIGHT,
    WIDTH,
    make_nuscenes,
    make_waymo,
    write_lines,
)
from tests.scene.street import background
from tests.typed import there

BARREL = [-0.3, 0.05, 0.002, -0.001, 0.01]
"""Moves pixels of a 40x24 image by up to 3.38, of one half as large by half of that."""
SLIGHT = [0.05, 0.0, 0.0, 0.0, 0.0]
"""By up to 0.378."""


def with_lenses(root):
    """A log whose first camera is a pinhole."""
    make_waymo(root, cameras=3)
    for camera, lens in ((1, BARREL), (2, SLIGHT)):
        write_lines(root / f"intrinsics/{camera}.txt", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *lens])
    return root


@pytest.mark.parametrize(("width", "shifts"), [(None, ("3.38", "0.378")), (20, ("1.69", "0.189"))])
def test_cameras_have_their_lenses_and_notes_say_how_far_they_move_pixels(width, shifts, tmp_path):
    """However little that is: a plan decides what is simulated."""
    log = DriveStudioReader(with_lenses(tmp_path), width=width).read()
    pinhole, *cameras = (view.camera for view in log.frames.views[-3:])
    assert pinhole.distortion is None
    for camera, lens in zip(cameras, (BARREL, SLIGHT), strict=True):
        assert torch.equal(there(camera.distortion), torch.tensor(lens))
    first, second = shifts
    assert log.notes[0] == f"camera 1: its lens moves pixels by up to {first}"
    assert log.notes[1] == f"camera 2: its lens moves pixels by up to {second}"
    assert len(log.notes) == 2


def test_lidar_meets_the_pixels_behind_the_lens(tmp_path):
    """(10, 2, 0.75) is 1.5 m to the left of camera 1 and 0.75 m below: 6 and 3 pixels from the center without a lens.
    r^2 = 0.028, and a barrel of -8 makes that 0.775 of it: 4.65 and 2.3."""
    lines = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, -8.0, 0, 0, 0, 0]
    write_lines(make_nuscenes(tmp_path) / "intrinsics/1.txt", lines)
    log = DriveStudioReader(tmp_path).read()
    depth = log.frames[1].depth
    assert depth[14, 15] == pytest.approx(10.0, abs=1e-5)
    assert depth[15, 14] == 0


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_scene_is_drawn_where_the_camera_of_a_log_sees_it(backend, tmp_path):
    """A Gaussian of 2 cm at 6 m, far off the center: the middle of what it covers is where the point projects."""
    view = DriveStudioReader(with_lenses(tmp_path)).read().frames.views[1]
    x, y, z = view.camera.position.tolist()
    point = torch.tensor([[x + 2.4, y + 6.0, z - 1.4]])  # Waymo's vehicle drives along y here
    columns = {
        "means": point,
        "log_scales": torch.full((1, 3), 0.02).log(),
        "quaternions": torch.tensor([[1.0, 0, 0, 0]]),
        "opacity_logits": torch.zeros(1),
        "sh_dc": torch.zeros(1, 1, 3),
        "sh_rest": torch.zeros(1, 0, 3),
    }
    alpha = render(SceneGraph({"a": background(Rows(columns))}), view, options=RenderOptions(backend=backend)).alpha
    row, column = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    middle = torch.stack(((column * alpha).sum(), (row * alpha).sum())) / alpha.sum()
    expected, _, inside = project(view.camera, point)
    assert inside.all()
    # Its pixels end where they fade into 1/255, not evenly around the middle.
    assert (middle - expected[0]).norm() < 0.1
    assert (middle - project(replace(view.camera, distortion=None), point)[0][0]).norm() > 1
