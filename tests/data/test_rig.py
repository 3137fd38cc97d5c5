"""Cameras of a rig, scaled."""

import torch

from sparsestreet.data.rig import rig_camera


def test_a_scaled_image_keeps_a_row():
    """100 x 3 pixels to a width of 10: 0.3 rows are one, and a pixel is 10 wide and 3 high."""
    intrinsics = torch.tensor([[200.0, 0, 50], [0, 200, 1.5], [0, 0, 1]], dtype=torch.float64)
    lens = torch.zeros(5, dtype=torch.float64)
    camera = rig_camera("front", 0, intrinsics=intrinsics, distortion=lens, recorded_size=(100, 3), width=10)
    assert camera.size == (10, 1)
    expected = torch.tensor([[20.0, 0, 5], [0, 200 / 3, 0.5], [0, 0, 1]])
    torch.testing.assert_close(camera.intrinsics, expected)
