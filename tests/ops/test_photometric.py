"""The photometric loss: all backends against its formula in float64, whose SSIM is torch's, and finite differences."""

import pytest
import torch
from torch import Tensor

from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.photometric import photometric
from sparsestreet.ops.ssim import ssim
from tests.ops.scenes import device_of, relative_error, with_threads

BACKENDS = ["torch", "cpu"] + ["triton"] * has_triton()
COTANGENT, WEIGHT, SHARE = -1.7, 0.6, 0.3
# Of D-SSIM's gradient in float32 (test_ssim.py); L1's is exact.
BARS = {torch.float32: 1e-5, torch.float64: 1e-12}


def images(height: int, width: int) -> tuple[Tensor, Tensor]:
    """An image that is partly above 1, and a recorded one that is partly white; numbers of float32 in float64."""
    generator = torch.Generator().manual_seed(height)
    recorded = torch.randint(0, 256, (height, width, 3), generator=generator).to(torch.uint8)
    recorded[:, ::3] = recorded[:, ::3].clamp(min=247)
    image = recorded / 255 + 0.4 * torch.randn(height, width, 3, generator=generator)
    return image.double(), recorded


def by_formula(image: Tensor, recorded: Tensor, white: int | None) -> tuple[Tensor, Tensor]:
    """Value and gradient: of a number that does not count, of the truth itself in its place."""
    truth = recorded.double() / 255
    rests = torch.zeros_like(truth, dtype=torch.bool) if white is None else (recorded >= white) & (image > truth)
    seen = torch.where(rests, truth, image).requires_grad_()
    value = WEIGHT * ((1 - SHARE) * (seen - truth).abs().mean() + SHARE * (1 - ssim(seen, truth, backend="torch")))
    (COTANGENT * value).backward()
    assert seen.grad is not None
    assert bool(rests.any()) == (white is not None)
    return value.detach(), seen.grad.masked_fill(rests, 0.0)


@pytest.mark.parametrize("size", [(13, 14), (33, 47)])
@pytest.mark.parametrize("white", [None, 250])
@pytest.mark.parametrize(
    ("backend", "dtype"),
    [(name, dtype) for name in BACKENDS for dtype in (torch.float32, torch.float64)[: 2 - (name == "triton")]],
)
def test_value_and_gradient_are_those_of_the_formula(backend, dtype, white, size):
    """The larger image has numbers in two blocks of every backend."""
    image, recorded = images(*size)
    value, gradient = by_formula(image, recorded, white)
    leaf = image.to(device_of(backend), dtype, copy=True).requires_grad_()
    recorded = recorded.to(leaf.device)
    found = photometric(leaf, recorded, lambda_dssim=SHARE, white=white, weight=WEIGHT, backend=backend)
    (COTANGENT * found).backward()
    assert leaf.grad is not None
    assert found.item() == pytest.approx(value.item(), rel=BARS[dtype])
    assert relative_error(leaf.grad.cpu().double(), gradient) <= BARS[dtype]
    assert torch.equal(leaf.grad.cpu() == 0, gradient == 0)


def test_finite_differences():
    image, recorded = images(12, 11)
    leaf = torch.where(recorded >= 250, image + 0.01, image).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda given: photometric(given, recorded, lambda_dssim=SHARE, white=250, backend="cpu"), leaf
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_views_no_gradient_l1_alone_and_what_is_refused(backend):
    image, recorded = (one.to(device_of(backend)) for one in images(13, 12))
    image = image.float()
    turned = image.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
    plain, other = (
        photometric(one, recorded, lambda_dssim=SHARE, white=250, backend=backend) for one in (image, turned)
    )
    assert not plain.requires_grad
    assert torch.equal(plain, other.detach())
    error = photometric(image[:3, :3], recorded[:3, :3], lambda_dssim=0.0, weight=2.0, backend=backend)
    truth = recorded[:3, :3].float() / 255
    torch.testing.assert_close(error, 2 * (image[:3, :3] - truth).abs().mean())
    with pytest.raises(ValueError, match="at least 11x11"):
        photometric(image[:10], recorded[:10], lambda_dssim=SHARE, backend=backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_number_that_is_none_is_not_hidden(backend):
    image, recorded = images(12, 12)
    image[3, 4, 1], recorded[3, 4, 1] = torch.nan, 255
    image, recorded = image.float().to(device_of(backend)), recorded.to(device_of(backend))
    assert bool(photometric(image, recorded, lambda_dssim=SHARE, white=250, backend=backend).isnan())


def test_the_same_bits_for_any_number_of_threads():
    image, recorded = images(97, 61)

    def answer() -> list[Tensor]:
        leaf = image.float().requires_grad_()
        value = photometric(leaf, recorded, lambda_dssim=SHARE, white=250, backend="cpu")
        return [value.detach(), *torch.autograd.grad(value, leaf)]

    alone, *others = with_threads((1, 2, 3), answer)
    assert all(all(map(torch.equal, alone, other)) for other in others)
