"""Errors, PSNR and SSIM against scikit-image and by hand."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from sparsestreet.metrics.definitions import (
    DEFINITIONS,
    DRIVESTUDIO,
    PROTOCOLS,
    PSNR_CAP,
    REGIONS,
    STRICT,
    metric_id,
    quantities_of,
)
from sparsestreet.metrics.image import (
    GAUSS11,
    UNIFORM7,
    masked_mse,
    masked_ssim_of_map,
    psnr,
    psnr_of_mse,
    psnr_on_device,
    rounded,
    ssim_map,
    ssim_of_map,
)
from tests.metrics.images import SIZES, TOLERANCE, image_pair


@pytest.mark.parametrize("size", SIZES)
def test_psnr_agrees_with_scikit_image(size):
    image, truth = image_pair(size)
    expected = peak_signal_noise_ratio(truth.numpy(), image.numpy(), data_range=1)
    assert psnr(image, truth) == pytest.approx(expected, abs=TOLERANCE)


def test_psnr_by_hand():
    truth = torch.zeros(3, 5, 3)
    assert psnr(truth + 0.1, truth) == pytest.approx(20, abs=1e-5)  # float32 holds 0.1 to 1e-8 relative
    image = truth.clone()
    image[1, 2, 0] = 0.5
    assert psnr(image, truth) == pytest.approx(-10 * math.log10(0.25 / 45), abs=TOLERANCE)


def test_psnr_is_capped_and_counts_tiny_errors():
    image, _ = image_pair((8, 8))
    assert psnr(image, image) == PSNR_CAP == 100
    assert psnr_of_mse(1e-12) == PSNR_CAP
    assert psnr_of_mse(1e-9) == pytest.approx(90)
    assert math.isnan(psnr_of_mse(math.nan))


@pytest.mark.parametrize("size", SIZES)
def test_psnr_on_a_device_is_the_same_number(size):
    image, truth = image_pair(size)
    # Two libraries' logarithms.
    assert float(psnr_on_device(image, truth)) == pytest.approx(psnr(image, truth), rel=1e-14)
    assert float(psnr_on_device(image, image)) == PSNR_CAP
    assert psnr_on_device(torch.full_like(image, torch.nan), truth).isnan()


@pytest.mark.parametrize("size", SIZES)
def test_a_masked_error_sees_the_mask_only(size):
    image, truth = image_pair(size)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(1)) < 0.3
    mask[0, 0] = True
    chosen = mask.numpy()
    expected = np.mean((image.numpy()[chosen] - truth.numpy()[chosen]) ** 2)
    poisoned = torch.where(mask[..., None], image, torch.nan)
    assert masked_mse(poisoned, truth, mask) == pytest.approx(expected, abs=TOLERANCE)
    assert masked_mse(image, truth, torch.zeros_like(mask)) is None


def test_rounding_to_eight_bits():
    """It costs what the table of definitions says: at half a level everywhere, 54.15 dB."""
    truth = torch.full((8, 8, 3), 100 / 255, dtype=torch.float64)
    assert psnr(truth + 0.499 / 255, truth) == pytest.approx(-20 * math.log10(0.499 / 255), abs=1e-9)
    assert psnr(rounded(truth + 0.499 / 255), truth) == PSNR_CAP
    assert psnr(rounded(truth + 0.501 / 255), truth) == pytest.approx(20 * math.log10(255), abs=1e-9)


def test_every_id_has_a_definition_that_names_its_region():
    assert metric_id("psnr", "vehicle") == "psnr_vehicle"
    assert "ssim_uniform7_full" in DEFINITIONS
    assert "vehicle" in DEFINITIONS["psnr_vehicle"]
    assert "with a lidar return of the same instant within 0.04" in DEFINITIONS["psnr_near_lidar"]
    assert "without a lidar return of the same instant within 0.04" in DEFINITIONS["ssim_uniform7_beyond_lidar"]
    assert "{" not in "".join(DEFINITIONS.values())
    assert len(set(DEFINITIONS.values())) == len(DEFINITIONS) == 6 * 7 + 2 * 3


def test_a_definition_says_over_what_it_is_averaged():
    """Windows leave the full image at its border; in a region they do not, and its pixels are averaged."""
    whole: dict[str, str] = {
        "ssim_uniform7": "less its 3 pixel border",
        "ssim_gauss11": "less its 5 pixel border",
        "lpips_alex": "each layer averaged over the image",
        "lpips_vgg": "each layer averaged over the image",
    }
    of_map: dict[str, str] = dict.fromkeys(
        ("ssim_uniform7", "ssim_gauss11"), "the map of the full image, borders by reflection"
    )
    of_map |= dict.fromkeys(("lpips_alex", "lpips_vgg"), "each layer's map of the full image")
    for region in REGIONS:
        for quantity in quantities_of(region):
            text = DEFINITIONS[metric_id(quantity, region)]
            expected = (whole if region == "full" else of_map).get(quantity)
            assert {said for said in (*whole.values(), *of_map.values()) if said in text} == {expected} - {None}


GAUSSIAN = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
"""How scikit-image's documentation says to match Wang et al. 2004."""


def expected_ssim(image, truth, window, **options) -> Any:
    """scikit-image in float64: its own float32 path loses digits in flat regions."""
    return structural_similarity(
        image.double().numpy(),
        truth.double().numpy(),
        data_range=1,
        channel_axis=-1,
        **(GAUSSIAN if window is GAUSS11 else {}),
        **options,
    )


@pytest.mark.parametrize(
    ("window", "size"),
    [
        (window, size)
        for window in (UNIFORM7, GAUSS11)
        for size in (*SIZES, (11, 11), (11, 30))
        if min(size) >= window.side
    ],
)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_ssim_is_scikit_images(size, dtype, window):
    image, truth = image_pair(size, dtype=dtype)
    expected, expected_map = expected_ssim(image, truth, window, full=True)
    found = ssim_map(image, truth, window)
    np.testing.assert_allclose(found.numpy(), expected_map, rtol=0, atol=TOLERANCE)
    assert ssim_of_map(found, window) == pytest.approx(expected, abs=TOLERANCE)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(2)) < 0.4
    mask[0, -1] = True  # a border pixel counts in the masked mean
    expected_in_mask = expected_map[mask.numpy()].mean()
    assert masked_ssim_of_map(found, mask) == pytest.approx(expected_in_mask, abs=TOLERANCE)
    assert masked_ssim_of_map(found, torch.zeros_like(mask)) is None


@pytest.mark.parametrize("window", [UNIFORM7, GAUSS11])
def test_ssim_keeps_its_digits_where_images_are_nearly_flat(window):
    """A sky of one gray with 1e-3 noise: variances of 1e-6, against float32's 6e-8 of E[x^2]."""
    generator = torch.Generator().manual_seed(3)
    truth = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    image = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    found = ssim_of_map(ssim_map(image, truth, window), window)
    assert found == pytest.approx(expected_ssim(image, truth, window), abs=TOLERANCE)


@pytest.mark.parametrize(("size", "window"), [((6, 7), UNIFORM7), ((7, 6), UNIFORM7), ((10, 40), GAUSS11)])
def test_images_below_the_window_are_refused(size, window):
    with pytest.raises(ValueError, match=rf"at least {window.side}x{window.side} pixels, got \d+x\d+"):
        ssim_map(torch.zeros(*size, 3), torch.zeros(*size, 3), window)


def test_the_protocols_choose_the_definitions_that_their_names_promise():
    assert DRIVESTUDIO.metrics == (
        *("psnr_full", "ssim_uniform7_full", "lpips_alex_full"),
        *("psnr_human", "ssim_uniform7_human", "psnr_vehicle", "ssim_uniform7_vehicle"),
    )
    assert STRICT.metrics == (
        *("psnr8_no_hood", "ssim_gauss11_no_hood", "lpips_alex_no_hood", "lpips_vgg_no_hood"),
        *("psnr8_human", "ssim_gauss11_human", "psnr8_vehicle", "ssim_gauss11_vehicle"),
    )
    assert {name: protocol.name for name, protocol in PROTOCOLS.items()} == {
        "drivestudio": "drivestudio",
        "strict": "strict",
    }


def test_a_metric_without_definition_is_refused():
    with pytest.raises(ValueError, match=r"protocol strict names \['psnr_hood'\]"):
        replace(STRICT, psnr="psnr_hood")
