"""Smaller images at the start of a training: when, how large, and that a view stays the same view."""

import numpy as np
import pytest
import torch
from PIL import Image

from sparsestreet.scene.rendering import render
from sparsestreet.training.schedule import Course, ResolutionSchedule, smaller
from tests.training.stubs import StubTrainer, background, frame_at, make_system


def test_sides_double_at_drivestudios_steps():
    schedule = ResolutionSchedule(halvings=2, double_in=250 / 30_000)
    assert [schedule.divisor(step, Course(30_000)) for step in (0, 249, 250, 499, 500, 29_999)] == [4, 4, 2, 2, 1, 1]
    pvg = ResolutionSchedule(halvings=3, double_in=5_000 / 30_000)
    assert [pvg.divisor(step, Course(30_000)) for step in (4_999, 5_000, 9_999, 10_000, 15_000)] == [8, 4, 4, 2, 1]
    for halvings, double_in in ((-1, 0.1), (2, 0.0)):
        with pytest.raises(ValueError, match="halvings >= 0 and double_in > 0"):
            ResolutionSchedule(halvings, double_in)


def test_whole_images_are_the_frame_itself():
    frame = frame_at()
    assert ResolutionSchedule().of(frame, 0, Course(100)) is frame
    assert ResolutionSchedule(halvings=1, double_in=0.1).of(frame, 10, Course(100)) is frame


def test_an_image_is_that_of_another_librarys_bicubic_filter():
    frame = frame_at(3, 24, 16)
    found = smaller(frame, 4).image
    expected = Image.fromarray(frame.image.numpy()).resize((6, 4), Image.Resampling.BICUBIC)
    # Both filters are antialiased with a = -0.5; Pillow rounds between its two passes.
    assert np.abs(found.numpy().astype(int) - np.asarray(expected).astype(int)).max() <= 1


def test_depth_is_the_mean_of_returns_and_masks_are_those_of_a_pixel():
    depth = torch.zeros(4, 4)
    depth[0, 0], depth[1, 1], depth[2, 3] = 2.0, 4.0, 7.0
    sky = torch.zeros(4, 4, dtype=torch.bool)
    sky[2, 2] = sky[1, 1] = True
    small = smaller(frame_at(0, 4, 4, depth=depth, sky=sky, ego=sky.T), 2)
    assert small.depth.tolist() == [[3.0, 0.0], [0.0, 7.0]]
    assert small.sky.tolist() == small.ego.tolist() == [[False, False], [False, True]]
    assert (small.human, small.vehicle) == (None, None)


def test_a_smaller_view_is_the_same_view():
    """The rendering of a smaller camera is about the mean over the pixels of the large one."""
    system = make_system({"background": background(40)})
    frame = frame_at(0, 256, 128)
    with torch.no_grad():
        large = render(system.scene, frame).rgb
        small = render(system.scene, smaller(frame, 2)).rgb
    means = large.reshape(64, 2, 128, 2, 3).mean((1, 3))
    shifted = (small[:, 1:] - means[:, :-1]).abs().mean()
    # A pixel is seen at its middle, and the low-pass of 0.3 px^2 is twice as wide; half a pixel off would be 0.4.
    assert (small - means).abs().mean() < 0.2 * shifted


def test_an_odd_size_keeps_the_field_of_view():
    camera = smaller(frame_at(0, 33, 17), 4).camera
    assert (camera.width, camera.height) == (8, 4)
    assert camera.intrinsics[0, 2].item() == pytest.approx(4)
    assert camera.intrinsics[1, 2].item() == pytest.approx(2)


def test_images_stay_as_large_as_the_window_of_ssim():
    schedule = ResolutionSchedule(halvings=3, double_in=0.1)
    assert schedule.of(frame_at(0, 90, 40), 0, Course(100)).camera.height == 13  # 40 // 3
    assert schedule.of(frame := frame_at(0, 90, 20), 0, Course(100)) is frame


def test_training_steps_see_small_images_first():
    sizes = []

    class Watch:
        def applies(self, frame) -> bool:
            return True

        def __call__(self, rendering, frame, scene):
            sizes.append((tuple(rendering.rgb.shape), frame.camera.width))
            return rendering.rgb.sum()

    system = make_system({"background": background(4)}, {"watch": Watch()})
    system.resolution = ResolutionSchedule(halvings=2, double_in=0.02)
    StubTrainer(system, max_steps=100).train(5, frame_at(0, 64, 48))
    assert sizes == [((12, 16, 3), 16)] * 2 + [((24, 32, 3), 32)] * 2 + [((48, 64, 3), 64)]
