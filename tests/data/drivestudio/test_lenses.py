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


BARREL_IS, SLIGHT_IS = "camera 1: its lens moves pixels by up to 3.38", "camera 2: its lens moves pixels by"
CHOICES = {
    "as it comes": ({}, (True, False), (f"{BARREL_IS} and is simulated", f"{SLIGHT_IS} at most 0.378 and is left out")),
    "every lens": ({"min_lens_shift": 0.0}, (True, True), (BARREL_IS, f"{SLIGHT_IS} up to 0.378 and is simulated")),
    "just so strong": ({"min_lens_shift": 3.38}, (True, False), (BARREL_IS, SLIGHT_IS)),
    "stronger ones": ({"min_lens_shift": 3.4}, (False, False), ("at most 3.38 and is left out", SLIGHT_IS)),
    "none": (
        {"min_lens_shift": None},
        (False, False),
        ("camera 1: its lens, which moves pixels by up to 3.38, is ignored, as asked", "camera 2: its lens, which"),
    ),
    "small images": ({"width": 20, "min_lens_shift": 1.7}, (False, False), ("at most 1.69", "at most 0.189")),
    "one camera": ({"cameras": [1]}, (True,), ("camera 1: its lens",)),
}


@pytest.mark.parametrize("name", CHOICES)
def test_a_lens_is_simulated_where_it_moves_pixels_far_enough(name, tmp_path):
    choice, simulated, notes = CHOICES[name]
    log = DriveStudioReader(with_lenses(tmp_path), **choice).read()
    assert len(log.notes) == len(notes)
    for note, start in zip(log.notes, notes, strict=True):
        assert start in note
    lenses = (BARREL, SLIGHT)
    cameras = [view.camera for view in log.frames.views[-len(simulated) :]]
    for camera, lens, used in zip(cameras, lenses, simulated, strict=False):
        assert (camera.distortion is not None) == used
        if used:
            assert torch.equal(there(camera.distortion), torch.tensor(lens))
    if name != "one camera":
        assert log.frames[0].camera.distortion is None  # the pinhole


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
