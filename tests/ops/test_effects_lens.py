"""Lens distortion: the unscented transform against its text-book form, against quadrature, and in limits."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
import torch

from sparsestreet.geometry.quaternions import from_matrix
from sparsestreet.ops import SplatSettings, guards, splat
from sparsestreet.types import Camera, Gaussians
from tests.ops.oracles import brown_conrady, fitted_splat, rotation_matrix
from tests.ops.scenes import (
    camera,
    cast,
    every_double,
    every_precision,
    front_camera,
    one_gaussian,
    random_gaussians,
    relative_error,
    render,
)

FITTED = SplatSettings(eps2d=0.0, alpha_min=0.0, transmittance_min=0.0)
WIDE = (-0.25, 0.08, 2e-3, -1e-3, -0.012)
"""Folds at r2 = 1.79, 53 degrees off the axis."""


def through(view: Camera, coefficients: tuple[float, ...]) -> Camera:
    return dataclasses.replace(view, distortion=torch.tensor(coefficients, dtype=torch.float64))


@cache
def fold(coefficients: tuple[float, ...]) -> float:
    """By search: where r radial(r2) stops growing, or grows more than fourfold."""
    r = np.linspace(0, 5, 2_000_001)
    grown = brown_conrady(r, 0 * r, (*coefficients[:2], 0.0, 0.0, coefficients[4]))[:, 0]
    slope = np.diff(grown) / np.diff(r)
    left = np.nonzero((slope < 0) | (slope > 4))[0]
    return float(r[left[0]]) ** 2 if len(left) else math.inf


def imaged(points: np.ndarray, view: Camera, near: float) -> np.ndarray:
    """Pixels of camera-frame points [.., 3], continued along the radius past the fold."""
    coefficients = tuple(view.distortion.tolist())
    z = np.maximum(points[..., 2], near)
    x, y = points[..., 0] / z, points[..., 1] / z
    shrink = np.sqrt(np.minimum(1, fold(coefficients) / np.maximum(x * x + y * y, 1e-300)))
    lens = brown_conrady(x * shrink, y * shrink, coefficients) / shrink[..., None]
    intrinsics = view.intrinsics.double().numpy()
    return lens * intrinsics.diagonal()[:2] + intrinsics[:2, 2]


def in_camera(gaussians: Gaussians, row: int, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Mean and axes (as columns) of one row in the camera frame."""
    pose = view.camera_from_world.double().numpy()
    axes = rotation_matrix(gaussians.quaternions[row].numpy()) @ np.diag(gaussians.scales[row].numpy())
    return pose[:3, :3] @ gaussians.means[row].numpy() + pose[:3, 3], pose[:3, :3] @ axes


def unscented(mean: np.ndarray, axes: np.ndarray, view: Camera, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance by the weights of Julier and Uhlmann: n + lambda = alpha^2 (n + kappa)."""
    n, alpha, beta, kappa = 3, 1.0, 2.0, 0.0
    spread = alpha**2 * (n + kappa)
    weight_mean = np.full(2 * n + 1, 0.5 / spread)
    weight_mean[0] = (spread - n) / spread
    weight_covariance = weight_mean.copy()
    weight_covariance[0] += 1 - alpha**2 + beta
    sigma = [mean] + [mean + sign * math.sqrt(spread) * axes[:, k] for k in range(n) for sign in (1, -1)]
    pixels = np.stack([imaged(point, view, near) for point in sigma])
    center = weight_mean @ pixels
    apart = pixels - center
    return center, np.einsum("i,ia,ib->ab", weight_covariance, apart, apart)


def quadrature(mean: np.ndarray, axes: np.ndarray, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Exact mean and covariance of the imaged Gaussian (Gauss-Hermite, 12 nodes an axis: to 5.5 sigma)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel() / weights.sum() ** 3
    pixels = imaged(mean + grid @ axes.T, view, 1e-9)
    center = weight @ pixels
    return center, np.einsum("i,ia,ib->ab", weight, pixels - center, pixels - center)


def wasserstein(mean: np.ndarray, covariance: np.ndarray, other: np.ndarray, spread: np.ndarray) -> float:
    """2-Wasserstein distance of two 2D Gaussians, pixels; trace(sqrt(M)) of a 2x2 M is sqrt(tr M + 2 sqrt(det M))."""
    product = covariance @ spread
    overlap = math.sqrt(np.trace(product) + 2 * math.sqrt(np.linalg.det(product)))
    return math.sqrt(((mean - other) ** 2).sum() + np.trace(covariance + spread) - 2 * overlap)


def drawn(gaussians: Gaussians, view: Camera, backend: str) -> tuple[np.ndarray, np.ndarray]:
    return fitted_splat(splat(gaussians, view, settings=FITTED, backend=backend).alpha.detach())


@pytest.mark.lengthy
@every_double
@pytest.mark.parametrize("coefficients", [WIDE, (0.1, 0.02, 0.0, 0.0, 0.0), (0.0,) * 5], ids=["wide", "pin", "zero"])
def test_against_the_text_book(backend, coefficients):
    view = through(camera(33, 25), coefficients)
    gaussians = random_gaussians(50, view, terms=1, seed=6)
    compared = 0
    for row in range(len(gaussians)):
        one = Gaussians(*(getattr(gaussians, name)[row : row + 1] for name in vars(one_gaussian())
                          if name != "displacements"))  # fmt: skip
        mean, axes = in_camera(gaussians, row, view)
        if mean[2] < 2 or (splat(one, view, settings=FITTED, backend=backend).alpha > 1e-3).sum() < 30:
            continue
        center, covariance = drawn(one, view, backend)
        expected_center, expected = unscented(mean, axes, view, FITTED.near_plane)
        np.testing.assert_allclose(center, expected_center, atol=1e-6)
        np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-6)
        compared += 1
    assert compared > 10


@pytest.mark.lengthy
@every_double
def test_sigma_points_past_the_fold_and_behind_the_near_plane(backend):
    # 40 degrees off the axis and as large as its distance: sigma points lie past the fold and behind the camera.
    view = through(front_camera(40, 30, 14.0), WIDE)
    for scales in ([0.9, 0.9, 0.1], [0.2, 0.2, 1.5]):
        ball = one_gaussian(means=[[1.2, 0.6, 1.5]], scales=[scales], quaternions=[[0.9, 0.2, -0.1, 0.3]])
        mean, axes = in_camera(ball, 0, view)
        points = mean + math.sqrt(3) * np.concatenate((axes.T, -axes.T))
        slopes = np.hypot(points[:, 0], points[:, 1]) / np.maximum(points[:, 2], FITTED.near_plane)
        assert (slopes**2 > fold(WIDE)).any()
        assert (points[:, 2] < FITTED.near_plane).any() == (scales[2] > 1)
        center, covariance = drawn(ball, view, backend)
        expected_center, expected = unscented(mean, axes, view, FITTED.near_plane)
        np.testing.assert_allclose(center, expected_center, rtol=1e-5)
        np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-5)
        assert render(ball, view, backend, torch.float32).is_finite()


@every_double
@pytest.mark.parametrize("off_axis", [0.0, 0.4, 0.8])
def test_closer_to_the_imaged_gaussian_than_its_linearization(backend, off_axis):
    # Gaussians of 5 to 10 % of their distance seen through a wide lens.
    view = through(front_camera(48, 40, 25.0), WIDE)
    turned = from_matrix(torch.from_numpy(rotation_matrix(np.array([0.8, 0.3, -0.2, 0.4]))))
    ball = one_gaussian(
        means=[[2 * off_axis, -off_axis, 2.0]], scales=[[0.2, 0.1, 0.15]], quaternions=[turned.tolist()]
    )
    mean, axes = in_camera(ball, 0, view)
    center, covariance = quadrature(mean, axes, view)
    step = 1e-5 * np.eye(3)
    jacobian = np.stack([(imaged(mean + d, view, 0.2) - imaged(mean - d, view, 0.2)) / 2e-5 for d in step], -1)
    linear = jacobian @ axes @ axes.T @ jacobian.T
    ours, spread = drawn(ball, view, backend)
    linear_mean = imaged(mean, view, 0.2)
    assert np.linalg.norm(ours - center) < 0.05 * np.linalg.norm(linear_mean - center)
    # The covariances alone are about equally far off, 1 % here.
    assert wasserstein(ours, spread, center, covariance) < 0.5 * wasserstein(linear_mean, linear, center, covariance)


@every_double
def test_zero_coefficients_tend_to_the_pinhole_with_size(backend):
    # The transform adds second derivatives times covariance: a quarter for half the size.
    view = front_camera(15, 13, 14.0)
    differences = []
    for size in (0.02, 0.01, 0.005):
        ball = one_gaussian(
            means=[[0.5, -0.3, 2.0]], scales=[[2 * size, size, size]], quaternions=[[0.9, 0.1, 0.3, 0.2]]
        )
        plain, bent = (
            splat(ball, seen, settings=SplatSettings(alpha_min=0.0), backend=backend).rgb
            for seen in (view, through(view, (0.0,) * 5))
        )
        differences.append(float((plain - bent).abs().max()))
    assert differences[0] > 1e-4
    assert differences[0] / differences[1] == pytest.approx(4, rel=0.1)
    assert differences[1] / differences[2] == pytest.approx(4, rel=0.03)


@every_precision
def test_what_the_lens_does_not_see_is_culled(backend, dtype):
    # k1 = -0.3 folds at r = 1.054: from there on the polynomial comes back towards the middle and would draw again.
    view = through(front_camera(41, 5, 20.0), (-0.3, 0.0, 0.0, 0.0, 0.0))
    drawn_rows = []
    for slope in (0.5, 1.05, 1.06, 1.6, 1.8, 3.0):
        ball = one_gaussian(means=[[2 * slope, 0.0, 2.0]])
        result = render(ball, view, backend, dtype)
        assert result.is_finite()
        drawn_rows.append(bool(result.radii[0] > 0))
        assert guards(cast(ball, dtype), view).past_fold == (not drawn_rows[-1])
        if not drawn_rows[-1]:
            assert not any(gradient.any() for gradient in result.gradients.values())
    assert drawn_rows == [True, True, False, False, False, False]


@pytest.mark.lengthy
@every_double
def test_float32(backend):
    # An image of real width: pixels are known to 1e-4, of which the covariance takes differences.
    view = through(front_camera(640, 8, 500.0), WIDE)
    gaussians = random_gaussians(400, view, seed=1)
    truth = render(gaussians, view, "reference", torch.float64)
    result = render(gaussians, view, backend, torch.float32)
    assert (result.images["rgb"] - truth.images["rgb"]).abs().max() < 1e-4
    for name, gradient in truth.gradients.items():
        assert relative_error(result.gradients[name], gradient) < 1e-4, name
