"""Frame by frame evaluation and its summary."""

import dataclasses
import statistics
import weakref

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from sparsestreet.evaluation import evaluate
from sparsestreet.evaluation.evaluate import evaluate_frames
from sparsestreet.evaluation.quality import FrameQuality, RegionQuality, summarize
from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.ops import SplatSettings
from sparsestreet.scene.rendering import RenderOptions, render
from tests.evaluation.frames import make_frame
from tests.evaluation.scenes import OPTIONS, replace_render, small_scene

SCENE = small_scene()


def noisy(view):
    """A render that leaves [0, 1] on both sides."""
    generator = torch.Generator().manual_seed(view.frame_index)
    return view.image.float() / 255 + 0.3 * torch.randn(view.image.shape, generator=generator)


@pytest.fixture
def noise(monkeypatch):
    replace_render(monkeypatch, noisy)


@pytest.mark.usefixtures("noise")
def test_a_frame_is_compared_with_its_clamped_render():
    vehicle = torch.zeros(9, 12, dtype=torch.bool)
    vehicle[2:5, 3:11] = True
    frame = make_frame(7, 2, vehicle=vehicle)
    (quality,) = evaluate_frames(SCENE, [frame], OPTIONS)

    truth = frame.image.double().numpy() / 255
    render = np.clip(noisy(frame).double().numpy(), 0, 1)
    error = (render - truth) ** 2
    _, similarity = structural_similarity(render, truth, data_range=1, channel_axis=-1, full=True)
    chosen = vehicle.numpy()
    # uint8 / 255 is rounded to float32 before the comparison: 6e-8 relative to values of order 1.
    assert (quality.frame, quality.camera, quality.width, quality.height) == (7, 2, 12, 9)
    assert quality.full.pixels == 108
    assert quality.full.mse == pytest.approx(error.mean(), abs=1e-7)
    assert quality.full.psnr == pytest.approx(-10 * np.log10(error.mean()), abs=1e-5)
    assert quality.full.ssim_uniform7 == pytest.approx(similarity[3:-3, 3:-3].mean(), abs=1e-5)
    assert quality.vehicle.pixels == 24
    assert quality.vehicle.psnr == pytest.approx(-10 * np.log10(error[chosen].mean()), abs=1e-5)
    assert quality.vehicle.ssim_uniform7 == pytest.approx(similarity[chosen].mean(), abs=1e-5)
    assert quality.human is None


@pytest.mark.usefixtures("noise")
def test_an_empty_mask_is_told_from_no_mask():
    empty = torch.zeros(9, 12, dtype=torch.bool)
    (quality,) = evaluate_frames(SCENE, [make_frame(human=empty)], OPTIONS)
    assert quality.human == RegionQuality(0, None, None, None)
    assert quality.vehicle is None


def test_the_scene_is_what_is_compared():
    """No render is replaced here: its options reach it, and an image of the scene itself is met."""
    frame = make_frame()
    for black in (OPTIONS, RenderOptions(SplatSettings(near_plane=50.0), "reference")):
        rgb = render(SCENE, frame, options=black).rgb.detach()
        seen = dataclasses.replace(frame, image=(rgb.clamp(0, 1) * 255).round().byte())
        (quality,) = evaluate_frames(SCENE, [seen], black)
        assert quality.full.psnr > 50  # 8 bits: at worst 54.2 dB away, half a level everywhere
    (quality,) = evaluate_frames(SCENE, [seen], OPTIONS)
    assert quality.full.psnr < 50


@pytest.mark.usefixtures("noise")
def test_frames_are_let_go_one_by_one():
    alive = []

    def stream():
        for index in range(4):
            assert sum(reference() is not None for reference in alive) <= 1
            frame = make_frame(index)
            alive.append(weakref.ref(frame))
            yield frame
            del frame

    assert len(list(evaluate_frames(SCENE, stream(), OPTIONS))) == 4


@pytest.mark.usefixtures("noise")
def test_each_frame_is_moved_to_the_scenes_device(monkeypatch):
    moved = []
    monkeypatch.setattr(evaluate, "to_device", lambda frame, device: moved.append((frame, device)) or frame)
    frames = [make_frame(0), make_frame(1)]
    list(evaluate_frames(SCENE, frames, OPTIONS))
    assert moved == [(frame, torch.device("cpu")) for frame in frames]


def test_rendering_takes_no_gradients(monkeypatch):
    seen = []
    replace_render(monkeypatch, lambda view: seen.append(torch.is_grad_enabled()) or noisy(view))
    list(evaluate_frames(SCENE, [make_frame()], OPTIONS))
    assert seen == [False]
    assert torch.is_grad_enabled()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_render_that_is_not_finite_is_refused(monkeypatch, value):
    def broken(view):
        rgb = noisy(view)
        rgb[1, 2, 0] = value
        return rgb

    replace_render(monkeypatch, broken)
    with pytest.raises(ValueError, match="frame 3, camera 1 has 1 values that are not finite"):
        list(evaluate_frames(SCENE, [make_frame(3, 1)], OPTIONS))


def test_summary_takes_means_over_the_images_that_have_the_region():
    def image(index, psnr, vehicle):
        return FrameQuality(index, 0, 8, 8, RegionQuality(64, 0.01, psnr, 0.5), None, vehicle)

    quality = [
        image(0, 20.0, RegionQuality(10, 0.1, 10.0, 0.4)),
        image(1, 100.0, RegionQuality(0, None, None, None)),
        image(2, 27.0, RegionQuality(1000, 0.001, 30.0, 0.6)),
    ]
    summary = summarize(quality)
    assert list(summary) == list(DEFINITIONS)
    assert summary["psnr_full"].mean == pytest.approx(49)
    assert summary["psnr_full"].sd == pytest.approx(statistics.stdev([20, 100, 27]))
    assert (summary["psnr_full"].images, summary["psnr_full"].capped) == (3, 1)
    assert summary["psnr_vehicle"].mean == pytest.approx(20)  # not weighted by pixels
    assert (summary["psnr_vehicle"].images, summary["psnr_vehicle"].capped) == (2, 0)
    assert (summary["psnr_human"].mean, summary["psnr_human"].sd, summary["psnr_human"].images) == (None, None, 0)


def test_summary_of_one_image_has_no_spread_and_of_none_no_mean():
    one = summarize([FrameQuality(0, 0, 8, 8, RegionQuality(64, 0.01, 20.0, 0.5))])
    assert (one["psnr_full"].mean, one["psnr_full"].sd) == (20.0, None)
    assert summarize([])["psnr_full"].images == 0
