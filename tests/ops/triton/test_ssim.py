"""The fused SSIM and its gradient against torch in float64, small enough for the interpreter."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.ssim import ssim
from sparsestreet.ops.triton import ssim as fused
from tests.ops.scenes import device_of, fill_buffers_with_nan, relative_error

DEVICE = device_of("triton")
COTANGENT = -1.7


def noise(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two images of noise in float64 that are half alike."""
    generator = torch.Generator().manual_seed(seed)
    image, other = (torch.rand(height, width, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    return image, (image + other) / 2


def value_and_gradient(image: Tensor, truth: Tensor, backend: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    device = DEVICE if backend == "triton" else torch.device("cpu")
    leaf = image.to(device, dtype).requires_grad_()
    value = ssim(leaf, truth.to(device, dtype), backend=backend)
    (COTANGENT * value).backward()
    return value.detach().cpu().double(), leaf.grad.cpu().double()


def assert_matches_float64(image: Tensor, truth: Tensor) -> None:
    # The images themselves are rounded for both: only the arithmetic is compared.
    image, truth = image.float().double(), truth.float().double()
    value, gradient = value_and_gradient(image, truth, "triton", torch.float32)
    wanted_value, wanted = value_and_gradient(image, truth, "torch", torch.float64)
    assert wanted.norm() > 0
    assert abs(value - wanted_value) <= 1e-6
    assert relative_error(gradient, wanted) <= 1e-5


@pytest.mark.parametrize(
    ("height", "width"), [(11, 11), pytest.param(13, 17, marks=pytest.mark.slow_if_interpreted), (12, 60), (43, 11)]
)
def test_odd_sizes_strips_and_blocks(height, width):
    """One window; several; columns in two programs (150 and 180 numbers); lines in two."""
    assert_matches_float64(*noise(height, width))


def test_a_gradient_that_enters_from_the_next_program(monkeypatch):
    """Programs smaller than the window."""
    monkeypatch.setattr(fused, "LINES", 4)
    monkeypatch.setattr(fused, "LANES", 16)
    assert_matches_float64(*noise(15, 12, seed=1))


def test_flat_and_alike_images():
    """A sky of one color: about zero, variances of 1e-6 beside squares of 3 would cost the gradient 5e-5."""
    generator = torch.Generator().manual_seed(2)
    truth = 0.9 + 1e-3 * torch.rand(14, 16, 3, generator=generator, dtype=torch.float64)
    image = truth + 1e-2 * torch.rand(14, 16, 3, generator=generator, dtype=torch.float64)
    assert_matches_float64(image, truth)


def test_equal_images_have_similarity_one_and_no_gradient():
    image, _ = noise(13, 14)
    value, gradient = value_and_gradient(image, image, "triton", torch.float32)
    assert float(value) == pytest.approx(1.0, abs=1e-6)
    assert float(gradient.abs().max()) == 0.0


def test_every_output_is_written(monkeypatch):
    fill_buffers_with_nan(monkeypatch)
    assert_matches_float64(*noise(12, 13, seed=3))


def test_a_view_and_no_gradient():
    """What the loss hands over may be transposed; without a gradient to come no derivative is stored."""
    image, truth = (plane.float().to(DEVICE) for plane in noise(13, 11, seed=4))
    plain = ssim(image, truth, backend="triton")
    turned = ssim(image.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_(), truth, backend="triton")
    assert not plain.requires_grad
    assert float(plain) == float(turned.detach())


@pytest.mark.parametrize("backend", ["torch", "triton"])
def test_the_truth_gets_no_gradient(backend):
    image, truth = (plane.float().to(DEVICE).requires_grad_() for plane in noise(11, 12, seed=5))
    ssim(image, truth, backend=backend).backward()
    assert truth.grad is None
    assert bool((image.grad != 0).all())


def test_small_images_and_other_types_are_refused():
    image, truth = noise(13, 11)
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(image[:, :10].float(), truth[:, :10].float(), backend="triton")
    with pytest.raises(ValueError, match="float32"):
        ssim(image, truth, backend="triton")


def test_images_too_large_for_int32_are_refused(monkeypatch):
    """Maps of 238,609,294 pixels hold 2^31 - 2 numbers; the window takes ten lines and columns from an image."""

    def launched(*_: object, **__: object) -> None:
        raise RuntimeError("launched")

    monkeypatch.setattr(fused, "launch", launched)
    line = torch.empty(11, 238_609_294 + 10, 3, device="meta", requires_grad=True)
    with pytest.raises(RuntimeError, match="launched"):
        fused.mean_ssim(line, line.detach())
    longer = torch.empty(11, 238_609_295 + 10, 3, device="meta", requires_grad=True)
    with pytest.raises(ValueError, match="up to 239 million pixels, got 238609305x11: use smaller"):
        fused.mean_ssim(longer, longer.detach())
