"""SSIM against scikit-image and by hand, with both windows."""

from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from sparsestreet.metrics.ssim import GAUSS11, UNIFORM7, masked_ssim, ssim, ssim_map
from tests.metrics.images import SIZES, TOLERANCE, image_pair

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
    np.testing.assert_allclose(ssim_map(image, truth, window).numpy(), expected_map, rtol=0, atol=TOLERANCE)
    assert ssim(image, truth, window) == pytest.approx(expected, abs=TOLERANCE)
    mask = torch.rand(size, generator=torch.Generator().manual_seed(2)) < 0.4
    mask[0, -1] = True  # a border pixel counts in the masked mean
    expected_in_mask = expected_map[mask.numpy()].mean()
    assert masked_ssim(image, truth, mask, window) == pytest.approx(expected_in_mask, abs=TOLERANCE)
    assert masked_ssim(image, truth, torch.zeros_like(mask), window) is None


@pytest.mark.parametrize("window", [UNIFORM7, GAUSS11])
def test_ssim_of_identical_images_is_one(window):
    image, _ = image_pair((12, 13))
    assert ssim(image, image, window) == pytest.approx(1, abs=TOLERANCE)


@pytest.mark.parametrize("window", [UNIFORM7, GAUSS11])
def test_ssim_keeps_its_digits_where_images_are_nearly_flat(window):
    """A sky of one gray with 1e-3 noise: variances of 1e-6, against float32's 6e-8 of E[x^2]."""
    generator = torch.Generator().manual_seed(3)
    truth = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    image = 0.9 + 1e-3 * torch.randn(20, 20, 3, generator=generator)
    assert ssim(image, truth, window) == pytest.approx(expected_ssim(image, truth, window), abs=TOLERANCE)


@pytest.mark.parametrize(("size", "window"), [((6, 7), UNIFORM7), ((7, 6), UNIFORM7), ((10, 40), GAUSS11)])
def test_images_below_the_window_are_refused(size, window):
    with pytest.raises(ValueError, match=rf"at least {window.side}x{window.side} pixels, got \d+x\d+"):
        ssim(torch.zeros(*size, 3), torch.zeros(*size, 3), window)
