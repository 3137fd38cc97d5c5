"""SSIM and its gradient in C++ and Triton against torch in float64 and finite differences."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.cpu.images import mean_ssim
from sparsestreet.ops.cpu.library import load_library
from sparsestreet.ops.ssim import ssim
from tests.ops.scenes import (
    device_of,
    every_fast_backend,
    every_fast_precision,
    fill_buffers_with_nan,
    relative_error,
    with_threads,
)

kernels = pytest.importorskip("sparsestreet.ops.triton.ssim")

COTANGENT = -1.7
# A variance is a mean of squares less the square of a mean, and a mean is rounded 25 times by up to half an ulp: 11
# taps down, 11 across, and what goes into them. That much of the squares is lost, beside the variances + 2 C2. In noise
# the squares are no larger than the variances, in flat images, about one of their colors, no larger than 2 C2 = 1.8e-3.
BAR = 25 * 2.0**-24
# A constant difference of 0.4 has no variance and the square 0.16, ninety times 2 C2.
BAR_OF_CONSTANTS = 90 * BAR
# In float64 torch is rounded as well, and takes variances about zero: squares of up to 4 beside C2.
BAR_OF_DOUBLES = 25 * 2.0**-53 * 4 / 9e-4


def noise(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two images of float32 noise, in float64, that are half alike."""
    generator = torch.Generator().manual_seed(seed)
    image, other = (torch.rand(height, width, 3, generator=generator).double() for _ in range(2))
    return image, ((image + other) / 2).float().double()


def bright_and_flat() -> tuple[Tensor, Tensor]:
    """A sky of one color and a little noise, and its picture a hundredth away."""
    image, other = noise(30, 45, seed=2)
    truth = 0.9 + 1e-3 * image
    return (truth + 1e-2 * other).float().double(), truth.float().double()


CASES: dict[str, tuple[Tensor, Tensor]] = {
    "one window": noise(11, 11),
    "few windows": noise(12, 37, seed=1),
    "odd sizes": noise(97, 61, seed=2),
    "wider than a block": noise(13, 203, seed=3),
    "out of [0, 1]": (4 * noise(20, 31)[0] - 1, 3 - 5 * noise(20, 31)[1]),
    "bright and flat": bright_and_flat(),
    "columns in two programs": noise(12, 60),
    "lines in two": noise(43, 11),
    "small and flat": (bright_and_flat()[0][:14, :16], bright_and_flat()[1][:14, :16]),
    "constant": (torch.full((18, 23, 3), 0.3).double(), torch.full((18, 23, 3), 0.7).double()),
}


def value_and_gradient(
    image: Tensor, truth: Tensor, call=ssim, dtype: torch.dtype = torch.float64, **options
) -> tuple[Tensor, Tensor]:
    device = device_of(options.get("backend", "cpu"))
    leaf = image.to(device, dtype, copy=True).requires_grad_()
    value = call(leaf, truth.to(device, dtype), **options)
    (COTANGENT * value).backward()
    return value.detach().cpu().double(), leaf.grad.cpu().double()


def assert_matches(result: tuple[Tensor, Tensor], image: Tensor, truth: Tensor, bar: float) -> None:
    value, gradient = value_and_gradient(image, truth, backend="torch")
    assert gradient.norm() > 0
    assert abs(result[0] - value) <= bar
    assert relative_error(result[1], gradient) <= bar


def bar_of(name: str, dtype: torch.dtype, backend: str = "cpu") -> float:
    if dtype == torch.float64:
        return BAR_OF_DOUBLES
    # Triton's own: the gradient's sums are in float32.
    return BAR_OF_CONSTANTS if name == "constant" else 1e-5 if backend == "triton" else BAR


SMALL = ("one window", "columns in two programs", "lines in two", "small and flat")


@pytest.mark.parametrize(
    ("name", "backend", "dtype"),
    [
        *[(name, "cpu", torch.float64) for name in CASES],
        *[pytest.param(name, "triton", torch.float32, marks=pytest.mark.interpreted) for name in SMALL],
    ],
)
def test_against_torch_in_double(name, backend, dtype):
    found = value_and_gradient(*CASES[name], backend=backend, dtype=dtype)
    assert_matches(found, *CASES[name], bar_of(name, dtype, backend))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("variant", [0, 1, 2])
def test_in_float_with_every_instruction_set(name, variant):
    if load_library().splat_variant_name(variant) is None:
        pytest.skip(f"this processor does not run variant {variant}")
    image, truth = CASES[name]
    result = value_and_gradient(image, truth, mean_ssim, torch.float32, variant=variant)
    assert_matches(result, image, truth, bar_of(name, torch.float32))


@every_fast_precision
def test_equal_images_have_similarity_one_and_no_gradient(backend, dtype):
    image = noise(13, 14)[0]
    value, gradient = value_and_gradient(image, image, dtype=dtype, backend=backend)
    # Two quotients of equal numbers, each a few roundings on a device.
    assert float(value) == pytest.approx(1.0, abs=8 * torch.finfo(dtype).eps)
    assert float(gradient.abs().max()) == 0.0


def test_finite_differences():
    image, truth = noise(13, 14)
    assert torch.autograd.gradcheck(lambda leaf: ssim(leaf, truth, backend="cpu"), image.requires_grad_())


@pytest.mark.lengthy
def test_the_same_bits_for_any_number_of_threads():
    """Of many blocks, and many images: two orders of adding often round to one sum."""
    pairs = [noise(641, 13, seed) for seed in range(20)]

    def answers() -> list[Tensor]:
        found = [value_and_gradient(*pair, dtype=torch.float32, backend="cpu") for pair in pairs]
        return [value for pair in found for value in pair]

    alone, *others = with_threads((1, 2, 3), answers)
    assert all(all(map(torch.equal, alone, other)) for other in others)


@every_fast_precision
def test_every_output_is_written(monkeypatch, backend, dtype):
    image, truth = noise(12, 13, seed=3)
    with monkeypatch.context() as patch:
        fill_buffers_with_nan(patch)
        result = value_and_gradient(image, truth, dtype=dtype, backend=backend)
    assert_matches(result, image, truth, bar_of("noise", dtype, backend))


@every_fast_backend
def test_views_of_images_and_no_gradient(backend):
    """A loss may hand over what is not contiguous; without a gradient to come no derivative is kept."""
    image, truth = (plane.float().to(device_of(backend)) for plane in noise(13, 11))
    turned = image.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
    plain = ssim(image, truth, backend=backend)
    assert not plain.requires_grad
    assert torch.equal(plain, ssim(turned, truth, backend=backend).detach())


@pytest.mark.parametrize("backend", ["torch", "cpu", "triton"])
def test_the_truth_gets_no_gradient(backend):
    image, truth = (plane.float().to(device_of(backend)).requires_grad_() for plane in noise(11, 12))
    ssim(image, truth, backend=backend).backward()
    assert truth.grad is None
    assert bool((image.grad != 0).all())


def test_a_gradient_that_enters_from_the_next_program(monkeypatch):
    """Programs smaller than the window."""
    monkeypatch.setattr(kernels, "LINES", 4)
    monkeypatch.setattr(kernels, "LANES", 16)
    pair = noise(15, 12, seed=1)
    assert_matches(value_and_gradient(*pair, dtype=torch.float32, backend="triton"), *pair, 1e-5)


def test_small_images_and_other_types_are_refused():
    image, truth = noise(13, 11)
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(image[:, :10].float(), truth[:, :10].float(), backend="triton")
    for backend in ("cpu", "triton"):  # "auto" takes torch
        with pytest.raises(ValueError, match="float32"):
            ssim(image, truth.float(), backend=backend)
    assert ssim(image, truth.float()).dtype == torch.float64


def test_images_too_large_for_int32_are_refused(monkeypatch):
    """Maps of 238,609,294 pixels hold 2^31 - 2 numbers; the window takes ten lines and columns from an image."""

    def launched(*_: object, **__: object) -> None:
        raise RuntimeError("launched")

    monkeypatch.setattr(kernels, "launch", launched)
    line = torch.empty(11, 238_609_294 + 10, 3, device="meta", requires_grad=True)
    with pytest.raises(RuntimeError, match="launched"):
        kernels.mean_ssim(line, line.detach())
    longer = torch.empty(11, 238_609_295 + 10, 3, device="meta", requires_grad=True)
    with pytest.raises(ValueError, match="up to 239 million pixels, got 238609305x11: use smaller"):
        kernels.mean_ssim(longer, longer.detach())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_pixel_that_is_no_number_is_not_hidden(dtype):
    image, truth = (plane.to(dtype) for plane in noise(20, 20))
    image[4, 7, 1] = torch.nan
    variants = [variant for variant in range(3) if load_library().splat_variant_name(variant)]
    assert all(bool(mean_ssim(image, truth, variant).isnan()) for variant in variants)
