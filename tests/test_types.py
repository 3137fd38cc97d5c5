"""What the frozen values that rooms hand to each other refuse to answer."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.types import Rendering
from tests.scene.street import view_at


def test_only_a_recorded_view_has_both_indices():
    """0 is an index: it is not taken for none."""
    recorded = replace(view_at(0.0), frame_index=0, camera_index=0)
    assert recorded.indices == (0, 0)
    for beside in (replace(recorded, frame_index=None), replace(recorded, camera_index=None)):
        with pytest.raises(ValueError, match="take the views of a log"):
            _ = beside.indices


def test_screen_gradients_are_there_after_a_backward_pass_only():
    offsets = torch.zeros(3, 2, requires_grad=True)
    image = torch.zeros(4, 5)
    rendering = Rendering(torch.zeros(4, 5, 3), image, image, torch.zeros(3), offsets)
    with pytest.raises(ValueError, match="screen_gradients=True"):
        _ = rendering.screen_gradients
    cotangent = torch.arange(6.0).reshape(3, 2)
    (offsets * cotangent).sum().backward()
    assert torch.equal(rendering.screen_gradients, cotangent)
