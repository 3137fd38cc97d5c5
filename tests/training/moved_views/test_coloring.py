"""Colors of returns without the gains of images, and how far other images agree."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from sparsestreet.training.moved_views.returns import Colors, agreement, seen_colors
from sparsestreet.types import Frame, View
from tests.training.moved_views.test_target import HEIGHT, WIDTH, at_pixel, camera

GAINS = {0: torch.tensor([1.0, 1.0, 1.0]), 1: torch.tensor([2.0, 1.0, 0.5])}


def gain(view: View) -> Tensor:
    return GAINS[view.indices[0]]


def frame(red: int, index: int = 0) -> Frame:
    """An image whose green is the column."""
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    image[..., 0], image[..., 1] = red, 20 * torch.arange(WIDTH, dtype=torch.uint8)
    return Frame(camera(), 0.0, index, 0, image=image)


def test_a_return_has_the_color_of_the_first_image_that_shows_it():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(3.5, 1.5, 12.0), at_pixel(30.0, 1.5, 5.0)])
    colors, seen = seen_colors(points, [frame(200, index=1), frame(100)], [points, points], gain)
    # The second is behind the first, the third outside.
    assert seen.tolist() == [True, False, False]
    torch.testing.assert_close(colors.values[0], torch.tensor([100, 40, 0]) / 255)
    assert not colors.cut_off.any()


def test_a_channel_at_white_is_a_lower_bound():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0)])
    colors, _ = seen_colors(points, [frame(250, index=1)], [points], gain)
    assert colors.cut_off.tolist() == [[True, False, False]]
    # Whatever is brighter than 125 of 255 may have been there; 100 misses 25, a third of it in the mean of channels.
    brighter, darker = (Colors(torch.tensor([[red, 40, 0]]) / 255, torch.zeros(1, 3).bool()) for red in (130, 100))
    assert colors.distance(brighter).item() == brighter.distance(colors).item() == 0
    assert colors.distance(darker).item() == pytest.approx(25 / 255 / 3, rel=1e-5)
    assert darker.distance(colors).item() == pytest.approx(25 / 255 / 3, rel=1e-5)
    # Two lower bounds never disagree.
    assert colors.distance(Colors(darker.values, colors.cut_off)).item() == 0
    assert colors.missing(brighter.values).tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("index", [0, 1])
def test_weights_fall_with_the_least_difference(index):
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(30.0, 1.5, 5.0)])
    colors = Colors(torch.tensor([[50, 40, 0], [9, 9, 9]]) / 255, torch.zeros(2, 3, dtype=torch.bool))
    others = [frame(round(red * float(GAINS[index][0])), index) for red in (100, 80)]
    weights = agreement(points, colors, others, 0.1, gain)
    assert weights[0] == pytest.approx(math.exp(-(30 / 255 / 3) / 0.1), rel=1e-5)
    assert weights[1] == 1  # no image shows it


def test_an_image_shows_nothing_behind_the_recording_car():
    points = torch.tensor([at_pixel(2.5, 1.5, 5.0), at_pixel(3.5, 1.5, 5.0)])
    hood = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hood[:, :3] = True
    masked = replace(frame(200), ego=hood)
    colors, seen = seen_colors(points, [masked], [points], gain)
    assert seen.tolist() == [False, True]
    assert not colors.values[0].any()
    both, _ = seen_colors(points, [masked, frame(100)], [points, points], gain)
    assert both.values[:, 0].tolist() == pytest.approx([100 / 255, 200 / 255])
    assert agreement(points, both, [masked], 0.1, gain)[0] == 1


def test_nothing_to_color():
    nothing = torch.zeros(0, 3)
    colors, seen = seen_colors(nothing, [frame(1)], [nothing], gain)
    assert colors.values.shape == colors.cut_off.shape == (0, 3)
    assert seen.shape == (0,)
    assert seen_colors(torch.ones(2, 3), [], [], gain)[1].tolist() == [False, False]
