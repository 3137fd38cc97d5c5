"""Colors of returns, and how far other images agree."""

import math
from dataclasses import replace

import pytest
import torch

from sparsestreet.training.moved_views.returns import agreement, seen_colors
from sparsestreet.types import Frame
from tests.training.moved_views.test_target import HEIGHT, WIDTH, at_pixel, camera


def frame(red: int, index: int = 0) -> Frame:
    """An image whose green is the column."""
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    image[..., 0], image[..., 1] = red, 20 * torch.arange(WIDTH, dtype=torch.uint8)
    return Frame(camera(), 0.0, index, 0, image=image)


def test_a_return_has_the_color_of_the_first_image_that_shows_it():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(3.5, 1.5, 12.0), at_pixel(30.0, 1.5, 5.0)])
    colors, seen = seen_colors(points, [frame(200), frame(100)])
    # The second is behind the first, the third outside.
    assert seen.tolist() == [True, False, False]
    torch.testing.assert_close(colors[0], torch.tensor([200, 40, 0]) / 255)


def test_weights_fall_with_the_least_difference():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(30.0, 1.5, 5.0)])
    colors = torch.tensor([[100, 40, 0], [9, 9, 9]]) / 255
    weights = agreement(points, colors, [frame(160), frame(130)], tolerance=0.1)
    assert weights[0] == pytest.approx(math.exp(-(30 / 255 / 3) / 0.1), rel=1e-5)
    assert weights[1] == 1  # no image shows it


def test_an_image_shows_nothing_behind_the_recording_car():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(3.5, 1.5, 5.0)])
    hood = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hood[:, :3] = True
    masked = replace(frame(200), ego=hood)
    colors, seen = seen_colors(points, [masked])
    assert seen.tolist() == [False, True]
    assert not colors[0].any()
    assert seen_colors(points, [masked, frame(100)])[0][:, 0].tolist() == pytest.approx([100 / 255, 200 / 255])
    assert agreement(points, torch.zeros(2, 3), [masked], tolerance=0.1)[0] == 1


def test_nothing_to_color():
    colors, seen = seen_colors(torch.zeros(0, 3), [frame(1)])
    assert colors.shape == (0, 3)
    assert seen.shape == (0,)
    assert seen_colors(torch.ones(2, 3), [])[1].tolist() == [False, False]
