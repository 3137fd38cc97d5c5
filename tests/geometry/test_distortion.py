"""Lens distortion against a hand-computed case, its polar form, finite differences and its inverse."""

import math

import numpy as np
import pytest
import torch

from sparsestreet.geometry import distortion
from sparsestreet.geometry.distortion import (
    _continued_jacobian,
    distort,
    distortion_jacobian,
    fold_radius_squared,
    largest_shift,
    undistort,
)

BARREL = torch.tensor([-0.3, 0.1, 0.0, 0.0, -0.02], dtype=torch.float64)
"""A wide-angle front camera's order of magnitude."""
FULL = torch.tensor([-0.28, 0.09, 2e-3, -1e-3, -0.012], dtype=torch.float64)
PINCUSHION = torch.tensor([0.2, 0.05, 0.0, 0.0, 0.01], dtype=torch.float64)


def test_by_hand():
    # x = 0.5, y = -1, r2 = 1.25: radial = 1 + 0.125 + 0.03125 + 0.05859375 = 1.21484375 for k = 0.1, 0.02, 0.03.
    # x: 0.5 radial + 2 * 0.01 * (-0.5) + 0.02 * (1.25 + 0.5);  y: -radial + 0.01 * (1.25 + 2) + 2 * 0.02 * (-0.5).
    coefficients = torch.tensor([0.1, 0.02, 0.01, 0.02, 0.03], dtype=torch.float64)
    values = distort(torch.tensor([[0.5, -1.0]], dtype=torch.float64), coefficients)
    assert values[0].tolist() == pytest.approx([0.632421875, -1.20234375], rel=1e-14)


def _naive(x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple[float, float]:
    """Polar form, one point at a time: the radius is scaled, then the tangential part is added."""
    r, angle = math.hypot(x, y), math.atan2(y, x)
    grown = r + k1 * r**3 + k2 * r**5 + k3 * r**7
    sine, cosine = math.sin(2 * angle), math.cos(2 * angle)
    x = grown * math.cos(angle) + r * r * (p1 * sine + p2 * (2 + cosine))
    y = grown * math.sin(angle) + r * r * (p1 * (2 - cosine) + p2 * sine)
    return x, y


@pytest.mark.parametrize("coefficients", [BARREL, FULL, PINCUSHION], ids=["barrel", "full", "pincushion"])
def test_against_the_polar_form(coefficients):
    points = torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5
    expected = np.array([_naive(*point, *coefficients.tolist()) for point in points.tolist()])
    np.testing.assert_allclose(distort(points, coefficients).numpy(), expected, rtol=1e-13, atol=1e-15)


def test_no_coefficients_no_distortion():
    points = torch.randn(20, 2, dtype=torch.float64)
    assert torch.equal(distort(points, torch.zeros(5)), points)


def test_fold_by_hand():
    # 1 + 3 k1 u = 0; 1 + 5 k2 u^2 = 0; 1 + 7 k3 u^3 = 0; (1 - u)(1 - u / 2) = 1 - 1.5 u + 0.5 u^2.
    def fold(k1=0.0, k2=0.0, k3=0.0):
        return fold_radius_squared(torch.tensor([k1, k2, 0.3, 0.3, k3], dtype=torch.float64))

    assert fold(k1=-0.1) == pytest.approx(1 / 0.3, rel=1e-12)
    assert fold(k2=-0.05) == pytest.approx(2.0, rel=1e-12)
    assert fold(k3=-1 / 56) == pytest.approx(2.0, rel=1e-12)
    assert fold(k1=-0.5, k2=0.1) == pytest.approx(1.0, rel=1e-12)
    # Too small a k3 to matter must not disturb the fold that k1 makes.
    assert fold(k1=-0.1, k3=1e-30) == pytest.approx(1 / 0.3, rel=1e-12)
    # Not folding, but too steep: 1 + 3 k1 u = 4; 1 - 0.3 u + 0.5 u^2 = 4.
    assert fold(k1=0.1) == pytest.approx(10, rel=1e-12)
    assert fold(k1=-0.1, k2=0.1) == pytest.approx(0.3 + math.sqrt(0.09 + 6), rel=1e-12)
    assert fold() == math.inf


@pytest.mark.parametrize("coefficients", [BARREL, FULL], ids=["barrel", "full"])
def test_fold_is_where_the_radius_stops_growing(coefficients):
    limit = math.sqrt(fold_radius_squared(coefficients))
    radial = coefficients * torch.tensor([1, 1, 0, 0, 1])
    radii = torch.linspace(0, 3 * limit, 4001, dtype=torch.float64)
    distorted = distort(torch.stack((radii, 0 * radii), -1), radial)[:, 0]
    # Continued past the fold it still grows, and it has no step.
    steps = distorted.diff()
    assert (steps > 0).all()
    assert steps.max() < 2 * 3 * limit / 4000
    k1, k2, _, _, k3 = coefficients.tolist()
    plain = radii + k1 * radii**3 + k2 * radii**5 + k3 * radii**7
    before = radii <= limit
    torch.testing.assert_close(distorted[before], plain[before])
    assert plain.diff()[before[1:]].min() > 0 > plain.diff()[~before[1:]][1]


def test_past_the_fold_it_is_proportional_to_the_radius():
    edge = math.sqrt(fold_radius_squared(FULL)) * torch.tensor([[0.6, 0.8], [-0.8, 0.6]], dtype=torch.float64)
    torch.testing.assert_close(distort(2.5 * edge, FULL), 2.5 * distort(edge, FULL), rtol=1e-12, atol=0)


@pytest.mark.parametrize("reach", [0.9, 3.0], ids=["before the fold", "across it"])
def test_derivative_in_the_points(reach):
    points = reach * (torch.rand(9, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5)
    assert torch.autograd.gradcheck(lambda value: distort(value, FULL), points.requires_grad_())
    # The center, where the radius has no derivative.
    assert torch.autograd.gradcheck(lambda value: distort(value, FULL), torch.zeros(1, 2).double().requires_grad_())


@pytest.mark.parametrize("coefficients", [FULL, PINCUSHION], ids=["full", "pincushion"])
@pytest.mark.parametrize(
    ("jacobian", "reach"), [(distortion_jacobian, 1.0), (_continued_jacobian, 6.0)], ids=["before the fold", "across"]
)
def test_jacobian(coefficients, jacobian, reach):
    points = reach * (torch.rand(9, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.5)
    for point, value in zip(points, jacobian(points, coefficients), strict=True):
        expected = torch.autograd.functional.jacobian(lambda at: distort(at, coefficients), point)
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("coefficients", [BARREL, FULL, PINCUSHION], ids=["barrel", "full", "pincushion"])
@pytest.mark.parametrize("reach", [1.0, 6.0], ids=["before the fold", "across it"])
def test_inverse(coefficients, reach):
    points = reach * (torch.rand(500, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64) - 0.5)
    imaged = distort(points, coefficients)
    found = undistort(imaged, coefficients)
    torch.testing.assert_close(distort(found, coefficients), imaged, rtol=1e-9, atol=1e-9)
    if reach == 1.0:  # At the fold itself the tangential terms give some points a second origin.
        torch.testing.assert_close(found, points, rtol=0, atol=1e-12)
    assert undistort(imaged.float(), coefficients).dtype == torch.float32
    assert undistort(points[:0], coefficients).shape == (0, 2)


def test_no_inverse_is_an_error():
    # Tangential terms of 1 fold the plane within the image: nothing is imaged at (-2, -2).
    wild = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"must have an inverse, but Newton's method is .* off for coefficients \[0.0"):
        undistort(torch.tensor([[-2.0, -2.0]], dtype=torch.float64), wild)
    # At other places the matrix of a step is singular.
    with pytest.raises(ValueError, match="must have an inverse"):
        largest_shift(torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), wild, 40, 40)


def test_the_inverse_stops_when_all_points_are_found(monkeypatch):
    steps = []
    jacobian = distortion._continued_jacobian
    monkeypatch.setattr(distortion, "_continued_jacobian", lambda *a: steps.append(a) or jacobian(*a))
    points = torch.rand(100, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.5
    torch.testing.assert_close(undistort(distort(points, FULL), FULL), points, rtol=0, atol=1e-14)
    assert 2 <= len(steps) <= 6  # digits double: 1e-1, 1e-2, 1e-4, 1e-8, and the step that is checked


def test_the_largest_shift_by_hand():
    """r = 1 is imaged at 1 + 0.1: (0.6, 0.8) at (0.66, 0.88), the top left corner, the farthest from the center."""
    intrinsics = torch.tensor([[100.0, 0, 66], [0, 200, 176], [0, 0, 1]])
    lens = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0])
    assert largest_shift(intrinsics, lens, 120, 300) == pytest.approx(math.hypot(6, 16), rel=1e-6)  # 0.1 in float32
    assert largest_shift(intrinsics, torch.zeros(5), 120, 300) == 0.0


def test_the_largest_shift_may_lie_inside():
    """r radial - r = r^3 (1 - r^2 / 0.7) (1 - r^2) / 2, in a square from whose middle the border is 0.71 to 1 away."""
    a, b = 1 / 0.7, 1.0
    lens = torch.tensor([0.5, -0.5 * (a + b), 0.0, 0.0, 0.5 * a * b], dtype=torch.float64)
    half = 100 * math.sqrt(0.5)
    intrinsics = torch.tensor([[100, 0, half], [0, 100, half], [0, 0, 1]], dtype=torch.float64)
    size = round(2 * half)
    radii = np.linspace(0, 1, 10_001)
    shift = 100 * np.abs(radii**3 * (1 - a * radii**2) * (1 - b * radii**2) / 2)
    at_border = shift[radii**2 > 0.46].max()  # 0.5 and more once imaged
    assert shift.max() > 1.1 * at_border
    assert largest_shift(intrinsics, lens, size, size) == pytest.approx(shift.max(), rel=1e-3)  # places of a grid
