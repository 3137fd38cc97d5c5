"""Image metrics against scikit-image and by hand."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from sparsestreet.metrics.definitions import DEFINITIONS, PSNR_CAP, metric_id
from sparsestreet.metrics.image import (
    masked_psnr,
    masked_ssim,
    psnr,
    psnr_of_mse,
    psnr_on_device,
    ssim,
    ssim_map,
)

SIZES = [(7, 7), (7, 8), (9, 31), (33, 14), (40, 41)]
# scikit-image sums the same float64 values in another order; a few ulp of a map of order 1, times the number of terms.
TOLERANCE = 1e-11


def image_pair(size: tuple[int, int], seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, ...]:
    """A smooth image with a flat patch (where variances vanish) and a noisy copy of it."""
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(*size, 3, generator=generator, dtype=torch.float64)
    truth[: size[0] // 2, : size[1] // 2] = 0.7
    noise = 0.1 * torch.randn(*size, 3, generator=generator, dtype=torch.float64)
    return (truth + noise).clamp(0, 1).to(dtype), truth.to(dtype)


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
def test_masked_psnr_sees_the_mask_only(size):
    image, truth = image_pair(size)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(1)) < 0.3
    mask[0, 0] = True
    chosen = mask.numpy()
    expected = -10 * math.log10(np.mean((image.numpy()[chosen] - truth.numpy()[chosen]) ** 2))
    assert masked_psnr(image, truth, mask) == pytest.approx(expected, abs=TOLERANCE)
    poisoned = torch.where(mask[..., None], image, torch.nan)
    assert masked_psnr(poisoned, truth, mask) == pytest.approx(expected, abs=TOLERANCE)
    assert masked_psnr(image, truth, torch.ones_like(mask)) == pytest.approx(psnr(image, truth), abs=TOLERANCE)


def test_metrics_of_an_empty_mask_are_none():
    image, truth = image_pair((8, 9))
    empty = torch.zeros(8, 9, dtype=torch.bool)
    assert masked_psnr(image, truth, empty) is None
    assert masked_ssim(image, truth, empty) is None


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_ssim_is_scikit_images_default(size, dtype):
    image, truth = image_pair(size, dtype=dtype)
    # The reference gets float64 values of the same numbers: its own float32 path loses digits in flat regions.
    reference = structural_similarity(
        image.double().numpy(), truth.double().numpy(), data_range=1, channel_axis=-1, full=True
    )
    expected, expected_map = reference
    np.testing.assert_allclose(ssim_map(image, truth).numpy(), expected_map, rtol=0, atol=TOLERANCE)
    assert ssim(image, truth) == pytest.approx(expected, abs=TOLERANCE)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(2)) < 0.4
    mask[0, -1] = True  # a border pixel counts in the masked mean
    assert masked_ssim(image, truth, mask) == pytest.approx(expected_map[mask.numpy()].mean(), abs=TOLERANCE)


def test_ssim_of_identical_images_is_one():
    image, _ = image_pair((12, 9))
    assert ssim(image, image) == pytest.approx(1, abs=TOLERANCE)


def test_ssim_keeps_its_digits_where_images_are_nearly_flat():
    """A sky of one gray with 1e-3 noise: variances of 1e-6, against float32's 6e-8 of E[x^2]."""
    generator = torch.Generator().manual_seed(3)
    truth = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    image = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    expected = structural_similarity(image.double().numpy(), truth.double().numpy(), data_range=1, channel_axis=-1)
    assert ssim(image, truth) == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.parametrize("size", [(6, 7), (7, 6), (1, 1)])
def test_images_below_the_window_are_refused(size):
    with pytest.raises(ValueError, match=r"at least 7x7 pixels, got \d+x\d+"):
        ssim(torch.zeros(*size, 3), torch.zeros(*size, 3))


def test_every_id_has_a_definition_that_names_its_region():
    assert metric_id("psnr", "vehicle") == "psnr_vehicle"
    assert "ssim_uniform7_full" in DEFINITIONS
    assert "vehicle" in DEFINITIONS["psnr_vehicle"]
    assert "with a lidar return of the same instant within 0.04" in DEFINITIONS["psnr_near_lidar"]
    assert "without a lidar return of the same instant within 0.04" in DEFINITIONS["ssim_uniform7_beyond_lidar"]
    assert "{" not in "".join(DEFINITIONS.values())
    assert len(set(DEFINITIONS.values())) == len(DEFINITIONS) == 15
