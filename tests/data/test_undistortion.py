"""Images without their lens, against directions through a pinhole and against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from sparsestreet.data.undistortion import Undistortion
from sparsestreet.geometry.distortion import undistort

WIDTH, HEIGHT = 60, 40
INTRINSICS = torch.tensor([[50.0, 0.0, 31.0], [0.0, 55.0, 18.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {"barrel": [-0.3, 0.1, 2e-3, -1e-3, -0.01], "pincushion": [0.2, 0.05, -1e-3, 2e-3, 0.0]}


def slopes() -> torch.Tensor:
    """x / z and y / z of the pixel centers of a pinhole [h, w, 2]."""
    column, row = torch.meshgrid(torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5, indexing="xy")
    center, focal = INTRINSICS[:2, 2], INTRINSICS.diagonal()[:2]
    return (torch.stack((column, row), -1).double() - center) / focal


def light(slopes: torch.Tensor) -> np.ndarray:
    """What comes from a direction: gentle slopes, so that bilinear interpolation of counts is right to one of them."""
    x, y = slopes.unbind(-1)
    return torch.stack((128 + 150 * x, 128 + 180 * y, 128 + 60 * x * y), -1).clamp(0, 255).round().byte().numpy()


def inside(lens: str) -> np.ndarray:
    """Pixels that the recorded image surrounds: a pixel from its border the light comes from outside of it too."""
    map_of = Undistortion.of(INTRINSICS, torch.tensor(LENSES[lens]), WIDTH, HEIGHT)
    in_columns = (map_of.columns >= 0) & (map_of.columns <= WIDTH - 1)
    return in_columns & (map_of.rows >= 0) & (map_of.rows <= HEIGHT - 1)


@pytest.mark.parametrize("lens", LENSES)
def test_what_a_lens_recorded_becomes_what_a_pinhole_records(lens):
    distortion = torch.tensor(LENSES[lens], dtype=torch.float64)
    recorded, wanted = light(undistort(slopes(), distortion)), light(slopes())
    seen = Undistortion.of(INTRINSICS, distortion, WIDTH, HEIGHT)(recorded)
    assert seen.shape == (HEIGHT, WIDTH, 3)
    known = inside(lens)
    # Both are rounded to counts.
    assert np.abs(seen.astype(int) - wanted)[known].max() <= 1
    assert np.abs(recorded.astype(int) - wanted)[known].max() > 5
    assert known.mean() > 0.7
    if lens == "pincushion":
        assert (seen[:2, :2] == 0).all()
        assert (recorded[:2, :2] > 0).any()


@pytest.mark.parametrize("lens", LENSES)
def test_opencv_does_the_same(lens):
    """Its pixel centers are whole numbers, so its principal point lies half a pixel nearer to the corner."""
    distortion = torch.tensor(LENSES[lens], dtype=torch.float64)
    recorded = light(undistort(slopes(), distortion))
    shifted = INTRINSICS.clone()
    shifted[:2, 2] -= 0.5
    expected = cv2.undistort(recorded, shifted.numpy(), distortion.numpy())
    seen = Undistortion.of(INTRINSICS, distortion, WIDTH, HEIGHT)(recorded)
    # It rounds places to a 32nd of a pixel, where colors change by 3 counts a pixel; at the border they fall to 0.
    known = inside(lens)
    assert np.abs(seen.astype(int) - expected)[known].max() <= 1


def test_a_mask_keeps_every_pixel_that_the_object_touches():
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20, 20:40] = 255
    distortion = torch.tensor(LENSES["barrel"])
    map_of = Undistortion.of(INTRINSICS, distortion, WIDTH, HEIGHT)
    seen, (columns, rows) = map_of(mask) > 0, (map_of.columns, map_of.rows)

    def within(margin: float) -> np.ndarray:
        """Places less than so many pixels from the center of a pixel of the mask."""
        return (np.abs(columns - 29.5) < 9.5 + margin) & (np.abs(rows - 14.5) < 4.5 + margin)

    # Bilinear weights are above 0 up to a pixel away; OpenCV rounds places to a 32nd of one, and loses half a count.
    assert not (seen & ~within(1 + 1 / 32)).any()
    assert not (within(1 - 2 / 32) & ~seen).any()
    assert within(1.0).sum() > within(0.5).sum() + 20
