"""What the frozen values that rooms hand to each other refuse to answer."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.types import Camera, Rendering, Track
from tests.scene.street import view_at


def test_a_camera_stands_where_its_axes_meet():
    """It looks along world x from (3, -1, 2): its own x is world -y, its y is world -z."""
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, torch.tensor([-1.0, 2.0, -3.0])
    assert Camera(pose, torch.eye(3), 2, 2).position.tolist() == [3.0, -1.0, 2.0]


def test_only_a_recorded_view_has_both_indices():
    """0 is an index: it is not taken for none."""
    recorded = replace(view_at(0.0), frame_index=0, camera_index=0)
    assert recorded.indices == (0, 0)
    for beside in (replace(recorded, frame_index=None), replace(recorded, camera_index=None)):
        with pytest.raises(ValueError, match="take the views of a log"):
            _ = beside.indices


def test_the_path_of_an_object_is_as_long_as_its_steps():
    """3, 4 and 0 m along the axes, then 5 m across two of them; turning is no way."""
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, :3, 3] = torch.tensor([[7.0, 1, 1], [10, 1, 1], [10, 5, 1], [10, 5, 1], [10, 2, 5]])
    poses[1, :2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    assert Track("0", "Vehicle", torch.arange(5), poses, torch.ones(3)).path_length == 12.0


def test_screen_gradients_are_there_after_a_backward_pass_only():
    offsets = torch.zeros(3, 2, requires_grad=True)
    image = torch.zeros(4, 5)
    rendering = Rendering(torch.zeros(4, 5, 3), image, image, torch.zeros(3), offsets)
    with pytest.raises(ValueError, match="screen_gradients=True"):
        _ = rendering.screen_gradients
    cotangent = torch.arange(6.0).reshape(3, 2)
    (offsets * cotangent).sum().backward()
    assert torch.equal(rendering.screen_gradients, cotangent)
