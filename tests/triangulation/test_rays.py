"""Points of least squared reprojection error, against exact worlds, finite differences, and noise that is drawn."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sparsestreet.triangulation.points import (
    Observations,
    _reprojection,
    _solved,
    meet,
    relative_depth_error,
    reprojection_errors,
)
from tests.triangulation.worlds import FOCAL, imaged, pose


def _observed(points, poses, rng, views=4):
    """Each point in some of the poses, all of which look at it."""
    chosen = np.concatenate([rng.choice(len(poses), views, replace=False) for _ in points])
    point = np.repeat(np.arange(len(points)), views)
    rays = np.array([imaged(points[[p]], poses[v])[0][0] for p, v in zip(point, chosen, strict=True)])
    return Observations(point, np.array(poses)[chosen], rays, np.full(len(rays), FOCAL))


@pytest.fixture
def poses():
    return [pose(x=x, z=z, yaw=yaw) for x, z, yaw in [(0, 0, 0), (1, 0.5, -4), (2, 0, 5), (3, 1, -9), (-1, 1.5, 8)]]


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform((-3, -2, 8), (5, 2, 40), (200, 3))


def test_rays_without_noise_meet_in_their_point(poses, points):
    rng = np.random.default_rng(1)
    observations = _observed(points, poses, rng)
    met = meet(observations, len(points))
    # Float64 keeps 16 digits; the square of a depth over a baseline (40 / 1) costs 3, the normal matrix as many again.
    np.testing.assert_allclose(met, points, rtol=0, atol=1e-9 * 40)
    error, depth = reprojection_errors(observations, met)
    assert error.max() < 1e-6
    assert (depth > 5).all()


def test_the_position_is_that_of_a_general_solver(poses, points):
    rng = np.random.default_rng(2)
    clean = _observed(points[:10], poses, rng)
    noisy = clean.rays + rng.normal(size=clean.rays.shape) * 0.5 / FOCAL
    observations = Observations(clean.point, clean.camera_from_frame, noisy, clean.focal)
    met = meet(observations, 10)
    for number in range(10):
        own = observations.where(observations.point == number)
        own = Observations(np.zeros_like(own.point), own.camera_from_frame, own.rays, own.focal)
        solved = least_squares(
            lambda x, own=own: _reprojection(own, x[None])[0].ravel(), points[number], xtol=1e-14, ftol=1e-14
        )
        # Gauss-Newton stops after 4 steps: far below the noise, which moves a point by centimeters.
        np.testing.assert_allclose(met[number], solved.x, rtol=0, atol=1e-4)


def test_the_derivative_of_the_reprojection_is_that_of_finite_differences(poses, points):
    observations = _observed(points, poses, np.random.default_rng(3))
    moved = points + 0.1
    jacobian = _reprojection(observations, moved)[1]
    step = 1e-5
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        after, before = (_reprojection(observations, moved + sign * offset)[0] for sign in (1, -1))
        # Central differences: an error of step^2 of values of some 30 pixels a meter, and rounding over the step.
        np.testing.assert_allclose(jacobian[:, :, axis], (after - before) / (2 * step), atol=1e-5)


@pytest.mark.lengthy
def test_the_predicted_error_is_that_of_drawn_noise(poses):
    """One point, seen in 4 views 4000 times: the spread along its least certain direction, over its distance."""
    rng = np.random.default_rng(4)
    draws, noise, point = 4000, 0.5, np.array([[1.0, 0.5, 20.0]])
    clean = _observed(np.repeat(point, draws, 0), poses[:4], rng)
    noisy = clean.rays + rng.normal(size=clean.rays.shape) * noise / FOCAL
    observations = Observations(clean.point, clean.camera_from_frame, noisy, clean.focal)
    met = meet(observations, draws)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(met.T))[-1])
    nearest = min(np.linalg.norm(point[0] - _center(camera)) for camera in poses[:4])
    predicted = np.median(relative_depth_error(observations, met, noise))
    # A standard deviation of 4000 draws is known to 1 / sqrt(8000) = 1.1 %.
    assert predicted == pytest.approx(spread / nearest, rel=0.05)
    np.testing.assert_allclose(met.mean(0), point[0], atol=5 * spread / np.sqrt(draws) + 0.01)


def _center(camera_from_world):
    return np.linalg.inv(camera_from_world)[:3, 3]


@pytest.mark.parametrize("apart", [0.0, 1e-9, -0.002], ids=["parallel", "almost", "diverging"])
def test_rays_that_do_not_meet_give_a_finite_point_that_is_not_believed(apart):
    rays = np.array([[0.1, 0.05], [0.1 + apart, 0.05]])
    observations = Observations(np.zeros(2, int), np.array([pose(x=1.0), pose()]), rays, np.full(2, FOCAL))
    met = meet(observations, 1)
    assert np.isfinite(met).all()
    error, depth = reprojection_errors(observations, met)
    agreed = (error < 0.6).all() and (depth > 0.5).all()
    assert not (agreed and relative_depth_error(observations, met, 0.5)[0] < 0.03)


def test_the_order_of_observations_does_not_matter(poses, points):
    rng = np.random.default_rng(5)
    observations = _observed(points, poses, rng)
    met = meet(observations.where(rng.permutation(len(observations))), len(points))
    np.testing.assert_allclose(met, meet(observations, len(points)), rtol=0, atol=1e-9 * 40)


def test_a_point_that_nothing_shows_is_at_the_origin_and_nothing_is_known_of_it(poses, points):
    some = _observed(points[:1], poses, np.random.default_rng(6))
    later = Observations(some.point + 1, some.camera_from_frame, some.rays, some.focal)
    met = meet(later, 2)
    assert (met[0] == 0).all()
    np.testing.assert_allclose(met[1], points[0], atol=1e-6)
    assert np.isinf(relative_depth_error(later, met, 0.5)[0])
    nothing = later.where(np.zeros(len(later), bool))
    assert meet(nothing, 0).shape == (0, 3)
    assert relative_depth_error(nothing, np.zeros((0, 3)), 0.5).shape == (0,)


def test_a_point_behind_a_camera_has_a_negative_depth():
    observations = Observations(np.zeros(1, int), pose()[None], np.zeros((1, 2)), np.array([FOCAL]))
    assert reprojection_errors(observations, np.array([[0.0, 0.0, -5.0]]))[1] == -5


def test_a_direction_that_nothing_determines_is_damped_by_a_billionth_of_the_trace():
    """1e-9 times the trace 2: what pulls as strongly moves a point by 1, what is determined is not changed."""
    solved = _solved(np.diag([1.0, 1.0, 0.0])[None], np.array([[3.0, -4.0, 2e-9]]))
    # Another 1e-12 stands beside the 2e-9.
    np.testing.assert_allclose(solved, [[3.0, -4.0, 1.0]], rtol=1e-3)
