"""Means over pixels and their gradients: all backends against NumPy in float64, and finite differences."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from sparsestreet.ops.backend import has_triton
from sparsestreet.ops.pixel_losses import depth_error, sky_entropy
from tests.ops.scenes import device_of, with_threads

BACKENDS = ["torch", "cpu"] + ["triton"] * has_triton()
COTANGENT = -1.7
SIZES = [(1, 1), (37, 23), (71, 61)]
"""The last has pixels in two blocks of every backend."""
LIMITS: dict[str, Any] = {"nearest": 2.0, "farthest": 9.0, "nearest_rendered": 1.0}
OPTIONS: dict[str, tuple[Callable[..., Tensor], dict[str, Any]]] = {
    "inverse depth": (depth_error, LIMITS),
    "depth": (depth_error, {**LIMITS, "inverse": False}),
    "sky": (sky_entropy, {"eps": 1e-2}),
    "sky with a floor": (sky_entropy, {"eps": 1e-2, "floor": 0.1}),
}


def images(name: str, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """What is predicted and what was recorded; numbers of float32 in float64."""
    generator = torch.Generator().manual_seed(sum(size))
    first, second = torch.rand(2, *size, generator=generator)
    if "sky" in name:
        return first.double(), second > 0.5
    rendered, measured = 12 * first, 12 * second
    measured.view(-1)[::7] = rendered.view(-1)[::7]  # no error, and no gradient
    measured.view(-1)[3::11] = 0.0
    rendered.view(-1)[5::13] = torch.nan
    return rendered.double(), measured.double()


def by_numpy(name: str, predicted: Tensor, truth: Tensor) -> tuple[float, np.ndarray]:
    """The mean and its gradient, weight 0.3."""
    x, y = predicted.numpy(), truth.numpy()
    if "sky" in name:
        sign, right = np.where(y, -1, 1), np.where(y, 1 - x, x)
        held = np.maximum(right, 0.1) if "floor" in name else right
        return -0.3 * np.log((held + 1e-2) / 1.01).mean(), -0.3 * sign / (held + 1e-2) / x.size
    counts = (y > 2) & (y < 9) & (x > 1)
    some, other = x[counts], y[counts]
    error, slope = (some - other, 1.0) if name == "depth" else (1 / some - 1 / other, -1 / some**2)
    number, gradient = max(counts.sum(), 1), np.zeros_like(x)
    gradient[counts] = 0.3 * np.sign(error) * slope / number
    return 0.3 * np.abs(error).sum() / number, gradient


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("backend", "dtype"),
    [(name, dtype) for name in BACKENDS for dtype in (torch.float32, torch.float64)[: 2 - (name == "triton")]],
)
def test_value_and_gradient_are_those_of_the_formula(name, size, backend, dtype):
    loss, options = OPTIONS[name]
    predicted, truth = images(name, size)
    value, gradient = by_numpy(name, predicted, truth)
    leaf = predicted.to(device_of(backend), dtype, copy=True).requires_grad_()
    recorded = truth.to(device_of(backend), torch.bool if "sky" in name else dtype)
    found = loss(leaf, recorded, weight=0.3, backend=backend, **options)
    (COTANGENT * found).backward()
    # Differences of inverse depths near 0.5 are rounded by that of 0.5, and the sum of thousands by more in torch.
    eps = torch.finfo(dtype).eps
    assert found.item() == pytest.approx(value, rel=40 * eps)
    assert leaf.grad is not None
    torch.testing.assert_close(
        leaf.grad.cpu().double(), COTANGENT * torch.from_numpy(gradient), rtol=20 * eps, atol=0, equal_nan=False
    )


@pytest.mark.parametrize("name", OPTIONS)
def test_finite_differences(name):
    loss, options = OPTIONS[name]
    predicted, truth = (image[:5, :7] for image in images(name, (37, 23)))
    predicted = predicted.nan_to_num(3.3)
    leaf = (predicted + 0.01 * (predicted == truth)).requires_grad_()
    if "floor" in name:
        leaf = predicted.clamp(0.11, 0.89).requires_grad_()
    assert torch.autograd.gradcheck(lambda image: loss(image, truth, backend="cpu", **options), leaf)


@pytest.mark.parametrize("backend", BACKENDS)
def test_views_no_gradient_and_nothing_that_counts(backend):
    rendered, measured = (image.float().to(device_of(backend)) for image in images("depth", (37, 23)))
    turned = rendered.T.contiguous().T
    answers = [depth_error(one, measured, backend=backend, **LIMITS) for one in (rendered, turned)]
    assert torch.equal(*answers)
    assert not answers[0].requires_grad
    leaf = rendered.clone().requires_grad_()
    nothing = depth_error(leaf, torch.zeros_like(measured), backend=backend)
    nothing.backward()
    assert nothing.item() == 0
    assert leaf.grad is not None
    assert not leaf.grad.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_alpha_that_is_no_number_is_not_hidden(backend):
    alpha = torch.full((3, 5), 0.5, device=device_of(backend))
    alpha[1, 2] = torch.nan
    sky = torch.zeros(3, 5, dtype=torch.bool, device=alpha.device)
    assert bool(sky_entropy(alpha, sky, floor=0.1, backend=backend).isnan())


def test_the_same_bits_for_any_number_of_threads():
    predicted, truth = images("sky", (300, 211))
    alone, *others = with_threads((1, 2, 3), lambda: [sky_entropy(predicted.float(), truth, backend="cpu")])
    assert all(torch.equal(alone[0], other[0]) for other in others)
