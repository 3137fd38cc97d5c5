"""Frame by frame evaluation and its summary."""

import dataclasses
import statistics
from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from sparsestreet.evaluation import evaluate
from sparsestreet.evaluation.evaluate import Predictions, evaluate_frames
from sparsestreet.metrics.definitions import DEFINITIONS
from sparsestreet.metrics.lpips import ALEX, Lpips, lpips_of_layers, masked_lpips_of_layers
from sparsestreet.ops import SplatSettings
from sparsestreet.records.summary import RegionQuality, camera_means, summarize
from sparsestreet.scene.rendering import RenderOptions, render
from tests.evaluation.frames import make_frame, make_image
from tests.evaluation.scenes import OPTIONS, replace_render, small_scene
from tests.metrics.networks import random_weights
from tests.typed import there

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
    render = np.round(np.clip(noisy(frame).double().numpy(), 0, 1) * 65535) / 65535
    error = (render - truth) ** 2
    whole: Any = structural_similarity(render, truth, data_range=1, channel_axis=-1, full=True)
    similarity = whole[1]
    chosen = vehicle.numpy()
    # uint8 / 255 is rounded to float32 before the comparison: 6e-8 relative to values of order 1.
    assert (quality.frame, quality.camera, quality.width, quality.height) == (7, 2, 12, 9)
    full, part = quality.regions["full"], quality.regions["vehicle"]
    assert full.pixels == 108
    assert full.mse == pytest.approx(error.mean(), abs=1e-7)
    assert full.psnr == pytest.approx(-10 * np.log10(error.mean()), abs=1e-5)
    assert full.ssim_uniform7 == pytest.approx(similarity[3:-3, 3:-3].mean(), abs=1e-5)
    assert part.pixels == 24
    assert part.psnr == pytest.approx(-10 * np.log10(error[chosen].mean()), abs=1e-5)
    assert part.ssim_uniform7 == pytest.approx(similarity[chosen].mean(), abs=1e-5)
    rounding = (np.round(render * 255) / 255 - truth) ** 2
    assert part.psnr8 == pytest.approx(-10 * np.log10(rounding[chosen].mean()), abs=1e-5)
    assert abs(there(part.psnr8) - there(part.psnr)) > 1e-4
    assert full.psnr8 == pytest.approx(-10 * np.log10(rounding.mean()), abs=1e-5)
    assert quality.regions["no_hood"].mse == full.mse
    assert (full.ssim_gauss11, full.lpips_alex) == (None, None)  # the image is lower than the windows
    assert set(quality.regions) == {"full", "no_hood", "vehicle"}


@pytest.mark.usefixtures("noise")
def test_an_empty_mask_is_told_from_no_mask():
    empty = torch.zeros(9, 12, dtype=torch.bool)
    (quality,) = evaluate_frames(SCENE, [make_frame(human=empty)], OPTIONS)
    assert quality.regions["human"] == RegionQuality(0, None, None, None)
    assert (quality.pixels("human"), quality.value("psnr", "human")) == (0, None)
    assert "vehicle" not in quality.regions
    assert (quality.pixels("vehicle"), quality.value("psnr", "vehicle")) == (0, None)


def lidar_regions(monkeypatch, depth, sky=None, ego=None):
    """Regions of a frame of 48 columns, whose render is off by 0.1 in the first 16, by 0.2 in the next and by 0.3."""
    error = torch.tensor([0.1, 0.2, 0.3]).repeat_interleave(16)[None, :, None]
    replace_render(monkeypatch, lambda view: view.image.float() / 255 + error)
    frame = make_frame(size=(9, 48), depth=depth, sky=sky, ego=ego)
    frame = dataclasses.replace(frame, image=frame.image // 2)  # so that no render is clamped
    (quality,) = evaluate_frames(SCENE, [frame], OPTIONS)
    return quality.regions


def test_near_and_beyond_the_lidar_without_the_sky(monkeypatch):
    """0.04 of 48 columns: near are two on either side of a return."""
    depth, sky = torch.zeros(9, 48), torch.zeros(9, 48, dtype=torch.bool)
    depth[:, 1] = 7.0
    regions = lidar_regions(monkeypatch, depth)
    near, beyond = regions["near_lidar"], regions["beyond_lidar"]
    assert (near.pixels, beyond.pixels) == (4 * 9, 44 * 9)
    # 16 bits round a value by at most 7.6e-6, its error of 0.3 squared by 4.6e-6.
    assert near.mse == pytest.approx(0.01, abs=5e-6)
    assert beyond.mse == pytest.approx((12 * 0.01 + 16 * 0.04 + 16 * 0.09) / 44, abs=5e-6)
    assert near.psnr == pytest.approx(20, abs=1e-3)
    sky[:, 2:32] = True
    regions = lidar_regions(monkeypatch, depth, sky)
    near, beyond = regions["near_lidar"], regions["beyond_lidar"]
    assert (near.pixels, beyond.pixels) == (2 * 9, 16 * 9)
    assert beyond.mse == pytest.approx(0.09, abs=5e-6)
    assert there(near.ssim_uniform7) > there(beyond.ssim_uniform7)
    hood = torch.zeros(9, 48, dtype=torch.bool)
    hood[6:] = True
    regions = lidar_regions(monkeypatch, depth, sky, hood)
    assert (regions["near_lidar"].pixels, regions["beyond_lidar"].pixels) == (2 * 6, 16 * 6)


def test_lidar_regions_at_their_ends(monkeypatch):
    """No lidar, no return in the image, returns everywhere."""
    assert set(lidar_regions(monkeypatch, None)) == {"full", "no_hood"}
    sky = torch.zeros(9, 48, dtype=torch.bool)
    sky[0] = True
    none = lidar_regions(monkeypatch, torch.zeros(9, 48), sky)
    assert (none["near_lidar"], none["beyond_lidar"].pixels) == (RegionQuality(0, None, None, None), 8 * 48)
    every = lidar_regions(monkeypatch, torch.ones(9, 48))
    assert (every["near_lidar"].pixels, every["beyond_lidar"]) == (9 * 48, RegionQuality(0, None, None, None))


def test_regions_of_masks(monkeypatch):
    """The render is off by 0.1, 0.2, 0.3 and 0.4 in the quarters of a frame, which are what the masks say."""
    columns = torch.arange(48).div(12, rounding_mode="floor")[None].expand(16, 48)
    replace_render(monkeypatch, lambda view: view.image.float() / 255 + 0.1 * (1 + columns[..., None]))
    masks: dict[str, Any] = {"ego": columns == 0, "human": columns == 1, "vehicle": columns == 2, "sky": columns == 3}
    frame = make_frame(size=(16, 48), **masks)
    frame = dataclasses.replace(frame, image=frame.image // 2)  # so that no render is clamped
    (quality,) = evaluate_frames(SCENE, [frame], OPTIONS)
    expected = {
        "no_hood": [0.04, 0.09, 0.16],
        "human": [0.04],
        "vehicle": [0.09],
        "static": [0.01, 0.16],
        "no_sky": [0.01, 0.04, 0.09],
    }
    assert set(quality.regions) == {"full", *expected}
    for region, errors in expected.items():
        found = quality.regions[region]
        assert found.pixels == len(errors) * 16 * 12
        assert found.mse == pytest.approx(np.mean(errors), abs=7e-6)  # 16 bits: 7.6e-6 of a value, twice 0.4 of it
        assert found.psnr8 == pytest.approx(-10 * np.log10(np.mean(errors)), abs=0.1)  # 0.1 is 25.5 levels
        assert found.ssim_gauss11 < 1
        assert found.lpips_alex is None
    (unmasked,) = evaluate_frames(SCENE, [make_frame(human=masks["human"], size=(16, 48))], OPTIONS)
    assert "static" not in unmasked.regions


@pytest.mark.usefixtures("noise")
def test_what_is_stored_is_what_is_compared(monkeypatch, tmp_path):
    """A file that held something else would be told by every number."""
    (kept,) = evaluate_frames(SCENE, [make_frame(3, 1)], OPTIONS, Predictions(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["003_1.png"]
    (in_memory,) = evaluate_frames(SCENE, [make_frame(3, 1)], OPTIONS)
    assert kept == in_memory
    read = Predictions.read
    monkeypatch.setattr(Predictions, "read", lambda *view: 65535 - read(*view))
    (inverted,) = evaluate_frames(SCENE, [make_frame(3, 1)], OPTIONS, Predictions(tmp_path))
    assert inverted.value("psnr", "full") < in_memory.value("psnr", "full") - 5


def test_an_exact_frame_is_exact_in_its_stored_prediction(monkeypatch, tmp_path):
    """All 256 levels, through a file of 16 bits: the cap, and the count of what was capped."""
    replace_render(monkeypatch, lambda view: view.image.float() / 255)
    image = torch.arange(256, dtype=torch.uint8).reshape(16, 16, 1).repeat(1, 1, 3)
    frame = dataclasses.replace(make_frame(size=(16, 16)), image=image)
    (quality,) = evaluate_frames(SCENE, [frame], OPTIONS, Predictions(tmp_path))
    for region in ("full", "no_hood"):
        assert (quality.value("mse", region), quality.value("psnr", region)) == (0, 100)
        assert quality.value("psnr8", region) == 100
        assert quality.value("ssim_gauss11", region) == pytest.approx(1, abs=1e-12)
    summary = summarize([quality, make_image(1)])
    assert [summary[name].capped for name in ("psnr_full", "psnr8_full", "psnr_no_hood", "mse_full")] == [1, 1, 1, 0]


def test_perceptual_distances_by_region(monkeypatch):
    lpips = Lpips(random_weights(ALEX))
    frame = make_frame(size=(40, 48), human=torch.zeros(40, 48, dtype=torch.bool))
    vehicle = torch.zeros(40, 48, dtype=torch.bool)
    vehicle[10:20] = True
    frame = dataclasses.replace(frame, vehicle=vehicle, depth=torch.ones(40, 48))
    replace_render(monkeypatch, noisy)
    (quality,) = evaluate_frames(SCENE, [frame], OPTIONS, lpips={"lpips_alex": lpips})
    stored = torch.round(noisy(frame).clamp(0, 1) * 65535) / 65535
    layers = lpips.layer_maps(stored, frame.image.float() / 255)
    # The last bits of float32 values that a network of five layers adds up.
    assert quality.value("lpips_alex", "full") == pytest.approx(lpips_of_layers(layers), abs=1e-6)
    assert quality.value("lpips_alex", "vehicle") == pytest.approx(masked_lpips_of_layers(layers, vehicle), abs=1e-6)
    assert quality.value("lpips_alex", "human") is None
    assert quality.value("lpips_alex", "near_lidar") is None  # no such pair is defined
    assert quality.value("lpips_vgg", "full") is None
    small = make_frame(size=(30, 48))
    (quality,) = evaluate_frames(SCENE, [small], OPTIONS, lpips={"lpips_alex": lpips})
    assert quality.value("lpips_alex", "full") is None


def test_the_scene_is_what_is_compared():
    """No render is replaced here: its options reach it, and an image of the scene itself is met."""
    frame = make_frame()
    for black in (OPTIONS, RenderOptions(SplatSettings(near_plane=50.0), "reference")):
        rgb = render(SCENE, frame, options=black).rgb.detach()
        seen = dataclasses.replace(frame, image=(rgb.clamp(0, 1) * 255).round().byte())
        (quality,) = evaluate_frames(SCENE, [seen], black)
        assert quality.value("psnr", "full") > 50  # 8 bits: at worst 54.2 dB away, half a level everywhere
    (quality,) = evaluate_frames(SCENE, [seen], OPTIONS)
    assert quality.value("psnr", "full") < 50


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
    quality = [
        make_image(0, psnr=20.0, vehicle=RegionQuality(10, 0.1, 10.0, 0.4)),
        make_image(1, psnr=100.0, vehicle=RegionQuality(0, None, None, None)),
        make_image(2, psnr=27.0, vehicle=RegionQuality(1000, 0.001, 30.0, 0.6)),
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
    one = summarize([make_image(0)])
    assert (one["psnr_full"].mean, one["psnr_full"].sd) == (20.0, None)
    assert summarize([])["psnr_full"].images == 0


def test_means_by_camera_are_over_the_cameras_own_images():
    quality = [
        make_image(0, 10, psnr=20.0, near_lidar=RegionQuality(10, 0.1, 10.0, 0.4)),
        make_image(0, 2, psnr=40.0),
        make_image(1, 10, psnr=23.0, near_lidar=RegionQuality(0, None, None, None)),
        make_image(2, 10, psnr=24.5, near_lidar=RegionQuality(1, 0.1, 13.0, 0.8)),
    ]
    means = camera_means(quality)
    assert list(means) == ["2", "10"]
    assert set(means["10"]) == set(DEFINITIONS)
    assert (means["10"]["psnr_full"], means["2"]["psnr_full"]) == (22.5, 40.0)
    assert (means["10"]["psnr_near_lidar"], means["2"]["psnr_near_lidar"]) == (11.5, None)
    assert means["10"]["ssim_uniform7_near_lidar"] == pytest.approx(0.6)
    assert camera_means([]) == {}
