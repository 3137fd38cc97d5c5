"""Other cameras on the same path: what a point of the world becomes in their images."""

import math

import pytest
import torch

from sparsestreet.export.path import recorded, resized
from sparsestreet.export.rig import cropped, pinholes, raised
from sparsestreet.geometry.cameras import project
from tests.export.street import street_views

PATH = recorded(street_views())
POINT = torch.tensor([[9.0, 0.5, 1.0]])


def test_a_raised_rig_sees_from_above():
    for before, after in zip(PATH[2], raised(PATH, 1.25)[2], strict=True):
        offset = after.camera.position - before.camera.position
        torch.testing.assert_close(offset, torch.tensor([0.0, 0.0, 1.25]), rtol=0, atol=2e-6)
        assert torch.equal(after.camera.camera_from_world[:3, :3], before.camera.camera_from_world[:3, :3])
        assert (after.frame_index, after.camera_index, after.time) == (None, before.camera_index, before.time)


@pytest.mark.parametrize("height", [20, 31, 48])
def test_rows_come_and_go_above_and_below(height):
    before, after = PATH[1][0].camera, cropped(PATH, height)[1][0].camera
    assert (after.width, after.height) == (before.width, height)
    (old, _, _), (new, _, _) = project(before, POINT), project(after, POINT)
    # The same distance from the middle row.
    torch.testing.assert_close(new[0, 1] - height / 2, old[0, 1] - before.height / 2)
    assert new[0, 0] == old[0, 0]


def test_a_pinhole_sees_as_far_as_its_field_of_view():
    camera = pinholes(resized(PATH, 60), 100.0)[0][0].camera
    assert (camera.width, camera.height, camera.distortion) == (60, 40, None)
    # Camera 0 looks along +x from (0, 0, 1.5); 50 degrees to the left and to the right are the edges.
    for side, edge in ((1, 0.0), (-1, 60.0)):
        there = torch.tensor([[10.0, side * 10.0 * math.tan(math.radians(50)), 1.5]])
        pixels, _, _ = project(camera, there)
        torch.testing.assert_close(pixels[0], torch.tensor([edge, 20.0]), rtol=0, atol=1e-4)
    with pytest.raises(ValueError, match="more than 0 and less than 180 degrees"):
        pinholes(PATH, 180.0)
