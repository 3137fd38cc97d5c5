"""Level, noise and cut-off pixels of images that are made with them."""

from dataclasses import replace

import pytest
import torch

from sparsestreet.data.lazy import Frames, as_frames
from sparsestreet.evidence.light import light_warnings, measured_light, sky_share
from sparsestreet.scene.effects import SkySettings
from sparsestreet.types import Camera, Frame
from tests.scene.street import street_log, training_data

HEIGHT, WIDTH = 30, 40


def frames(level: float, noise: float = 0.0, white: float = 0.0) -> Frames:
    """Ten images of one level with noise; ``white`` of the last one's pixels are."""
    draw, made = torch.Generator().manual_seed(0), []
    for index in range(10):
        image = (level + noise * torch.randn(HEIGHT, WIDTH, 1, generator=draw)).expand(-1, -1, 3).clone()
        image[: round(white * HEIGHT) if index == 9 else 0] = 255.0
        camera = Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT)
        made.append(Frame(camera, index / 9, index, 0, image=image.round().clamp(0, 255).byte()))
    return as_frames(made)


def test_level_and_noise_are_those_of_the_images():
    found = measured_light(frames(90, noise=6))
    assert found.level == pytest.approx(90, abs=0.5)
    # 1,200 pixels: the median of absolute values is known to 4 %; rounding adds 0.3 levels.
    # Gray is the mean of equal channels, so their noise is its own.
    assert found.noise == pytest.approx(6, rel=0.1)
    assert (found.clipped, found.worst, found.images) == (0, 0, 10)


def test_cut_off_pixels_are_counted_and_the_worst_image_is_named():
    found = measured_light(frames(90, white=0.5))
    assert found.clipped == pytest.approx(0.05)
    assert (found.worst, found.worst_frame) == (pytest.approx(0.5), 9)


def test_of_many_images_the_worst_has_its_own_frame():
    """Of 80 not all are looked at, but the last one is."""
    ten = frames(90, white=0.5)
    many = [replace(ten[9 if index == 79 else 0], frame_index=index) for index in range(80)]
    found = measured_light(as_frames(many))
    assert found.images < 80
    assert found.worst_frame == 79


def test_a_lamp_of_one_color_is_not_cut_off():
    red = [replace(frame, image=frame.image.clone()) for frame in frames(90)]
    for frame in red:
        frame.image[..., 0] = 255
    assert measured_light(as_frames(red)).clipped == 0


def test_sky_and_car_do_not_count():
    top = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    top[:15] = True
    masked = [replace(frame, sky=top) for frame in frames(90, white=0.5)]
    assert measured_light(as_frames(masked)).clipped == 0
    nothing = [replace(frame, sky=top, ego=~top) for frame in frames(5, white=0.5)]
    assert measured_light(as_frames(nothing)).level == 128


@pytest.mark.parametrize(
    ("level", "white", "doubts"),
    [
        (60, 0.0, []),
        (30, 0.0, ["10 images have a mean gray level of 30 of 255"]),
        (0, 0.0, ["10 images have a mean gray level of 0 of 255"]),
        (90, 0.1, []),
        (90, 0.4, ["most in frame 9 (40.0 %)"]),
    ],
)
def test_dark_and_clipped_images_are_doubted_and_the_worst_is_named(level: float, white: float, doubts: list[str]):
    said = tuple(light_warnings(measured_light(frames(level, white=white))))
    assert [doubt in line for doubt, line in zip(doubts, said, strict=True)] == [True] * len(doubts)


def test_the_record_counts_stops():
    assert measured_light(frames(59)).numbers()["stops_below_middle_gray"] == pytest.approx(1)  # half of 118


def frames_sky(*shares: float) -> Frames:
    """The street's first frames, each with this share of its pixels masked."""
    made = []
    for frame, share in zip(street_log().frames, shares, strict=False):
        height, width, _ = frame.image.shape
        mask = torch.arange(height * width).reshape(height, width) < share * height * width
        made.append(replace(frame, sky=mask))
    return as_frames(made)


def test_mean_and_error_are_over_images():
    found = sky_share(frames_sky(0.2, 0.4, 0.6))
    assert found is not None
    assert found.share == pytest.approx(0.4, abs=2e-3)  # a pixel of 33 x 21 is 0.0014
    assert found.error == pytest.approx(0.2 / 3**0.5, abs=2e-3)
    assert found.frames == 3


@pytest.mark.parametrize(("share", "wanted"), [(0.0, False), (0.0025, False), (0.01, True)])
def test_a_tunnel_has_none(share: float, wanted: bool):
    data = replace(training_data(), frames=frames_sky(share, share))
    found = SkySettings().detect(data)
    assert (found.called_for, found.missing) == (wanted, None)


def test_without_masks_there_is_a_sky():
    data = training_data()
    assert sky_share(as_frames([replace(frame, sky=None) for frame in data.frames])) is None
    found = SkySettings().detect(replace(data, frames=as_frames([replace(frame, sky=None) for frame in data.frames])))
    assert (found.called_for, found.value) == (True, None)
