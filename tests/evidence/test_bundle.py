"""Corrections of a few poses against scipy's least squares over poses and points together."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sparsestreet.evidence.poses import MIN_NOISE, PRIOR, adjust
from sparsestreet.triangulation.points import Observations, meet

IMAGES, POINTS, FOCAL = 3, 12, 8.0
"""So few pixels a meter that the prior weighs about as much as the rays."""


def moved(poses: np.ndarray, corrections: np.ndarray) -> np.ndarray:
    """Poses behind translations (m) and rotation vectors in the frames of the cameras."""
    by = np.tile(np.eye(4), (len(poses), 1, 1))
    by[:, :3, :3], by[:, :3, 3] = Rotation.from_rotvec(corrections[:, 3:]).as_matrix(), corrections[:, :3]
    return by @ poses


def imaged(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[images, points, 2]"""
    local = np.einsum("cij,pj->cpi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    return local[..., :2] / local[..., 2:]


def test_corrections_are_the_least_squares_of_rays_and_prior():
    draw = np.random.default_rng(2)
    recorded = np.tile(np.eye(4), (IMAGES, 1, 1))
    recorded[:, 0, 3] = -2.0 * np.arange(IMAGES)
    places = draw.uniform((-3, -3, 5), (7, 3, 12), (POINTS, 3))
    rays = imaged(moved(recorded, PRIOR * draw.standard_normal((IMAGES, 6))), places)
    image, point = np.repeat(np.arange(IMAGES), POINTS), np.tile(np.arange(POINTS), IMAGES)
    observations = Observations(point, recorded[image], rays.reshape(-1, 2), np.full(len(image), FOCAL))

    def residuals(unknown: np.ndarray) -> np.ndarray:
        corrections, points = np.split(unknown, [6 * IMAGES])
        pixels = FOCAL * (imaged(moved(recorded, corrections.reshape(-1, 6)), points.reshape(-1, 3)) - rays)
        # Geman and McClure: the square s becomes s / (1 + s), here of three times the noise.
        pixels = pixels.reshape(-1, 2) / MIN_NOISE
        robust = pixels / np.sqrt(1 + np.square(pixels / 3).sum(1, keepdims=True))
        return np.concatenate((robust.ravel(), corrections / np.tile(PRIOR, IMAGES)))

    start = np.concatenate((np.zeros(6 * IMAGES), meet(observations, POINTS).ravel()))
    wanted = least_squares(residuals, start, xtol=1e-12, ftol=1e-12).x[: 6 * IMAGES].reshape(-1, 6)
    found = adjust(observations, image, IMAGES)
    off = np.abs(found.corrections - wanted) / PRIOR
    assert np.abs(wanted / PRIOR).max() > 1
    # Derivatives of turns are taken at no turn; 0.0002 are left of turns of 0.03 rad.
    assert off.max() < 0.002
    assert found.counts.tolist() == [POINTS] * IMAGES
