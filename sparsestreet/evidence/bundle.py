"""Small corrections of camera poses that make the rays of points meet: one bundle adjustment of a few images."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int

from sparsestreet.triangulation.rays import Observations, meet, summed

STEPS = 10
LEAST_NOISE = 0.05
"""Pixels; the position of a feature is not known better."""
PRIOR = np.repeat((0.3, 0.03), 3)
"""Standard deviations of corrections, meters and radians: what rays leave open stays near zero."""


@dataclass(frozen=True)
class Bundle:
    """Corrections as motions in the frames of the cameras, and what these move images by."""

    corrections: Float64[np.ndarray, "c 6"]
    """Translation (m) and rotation vector (rad) of each image; 0 of one without observations."""
    slopes: Float64[np.ndarray, "c 6 6"]
    """Mean product of the derivatives of an image's pixels with respect to its correction: with it the mean square of
    what a correction moves the image by, over both axes, is c^T slopes c, in pixels^2."""
    covariance: Float64[np.ndarray, "c 6 c 6"]
    """Of the corrections, by the noise of features alone: how far what rays say disagrees. The prior is no noise."""
    counts: Int[np.ndarray, " c"]
    """Observations of each image."""


def adjust(observations: Observations, image: Int[np.ndarray, " o"], images: int) -> Bundle:
    """Corrections of ``images`` cameras by Gauss-Newton; ``image`` is that of each observation.

    Points are eliminated (Schur), and the corrections have a weak prior. Points start where the rays come closest.
    """
    count = int(observations.point.max(initial=-1)) + 1
    moved, points = observations.camera_from_frame.copy(), meet(observations, count)
    corrections, size = np.zeros((images, 6)), 6 * images
    prior = np.tile(1 / PRIOR**2, images)
    for _ in range(STEPS):
        residual, by_pose, by_point = _derivatives(replace(observations, camera_from_frame=moved), points)
        # Of wrong matches, which there are always some, nothing is left when the noise is found (Geman and McClure).
        noise = max(1.4826 * float(np.median(np.abs(residual))), LEAST_NOISE)
        ratio = (residual / (3 * noise)) ** 2
        weight = ((1 + ratio.sum(1)) ** -2 / noise**2)[:, None, None]
        own = _damped(summed(_product(by_point, weight * by_point), observations.point, count))
        mixed = _scattered(_product(by_pose, weight * by_point), image, observations.point, images, count)
        data = np.zeros((size, size))
        for number, block in enumerate(summed(_product(by_pose, weight * by_pose), image, images)):
            data[6 * number : 6 * number + 6, 6 * number : 6 * number + 6] = block
        inverse = np.linalg.inv(own)
        data -= np.einsum("pai,pij,pbj->ab", mixed, inverse, mixed, optimize=True)
        right_pose = summed(_product(by_pose, weight * residual[:, :, None])[:, :, 0], image, images).ravel()
        right_point = summed(_product(by_point, weight * residual[:, :, None])[:, :, 0], observations.point, count)
        right = right_pose - np.einsum("pai,pij,pj->a", mixed, inverse, right_point, optimize=True)
        right += prior * corrections.ravel()
        step = -np.linalg.solve(data + np.diag(prior), right)
        points = points - np.einsum("pij,pj->pi", inverse, right_point + np.einsum("pai,a->pi", mixed, step))
        corrections = corrections + step.reshape(images, 6)
        moved = _moved(observations.camera_from_frame, corrections[image])
    # What noise of the data alone would make of the estimate, which the prior shrinks.
    shrunk = np.linalg.inv(data + np.diag(prior))
    covariance = shrunk @ data @ shrunk
    counts = np.bincount(image, minlength=images)
    slopes = summed(_product(by_pose, by_pose), image, images) / (2 * np.maximum(counts, 1))[:, None, None]
    return Bundle(corrections, slopes, covariance.reshape(images, 6, images, 6), counts)


def _derivatives(
    observations: Observations, points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "o 2"], Float64[np.ndarray, "o 2 6"], Float64[np.ndarray, "o 2 3"]]:
    """Residuals in pixels, and their derivatives with respect to the camera's motion and to the point."""
    rotation = observations.camera_from_frame[:, :3, :3]
    local = np.einsum("oij,oj->oi", rotation, points[observations.point]) + observations.camera_from_frame[:, :3, 3]
    depth = np.maximum(local[:, 2], 0.1)
    at = local[:, :2] / depth[:, None]
    by_local = np.zeros((len(local), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = 1
    by_local[:, :, 2] = -at
    by_local *= (observations.focal / depth)[:, None, None]
    # A turn by w moves a point by w x local: each column is a unit vector x local.
    turned = np.cross(np.eye(3)[None], local[:, None, :])
    by_turn = np.einsum("oij,okj->oik", by_local, turned)
    residual = (at - observations.rays) * observations.focal[:, None]
    return residual, np.concatenate((by_local, by_turn), 2), by_local @ rotation


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^T b of each observation."""
    return np.einsum("oki,okj->oij", a, b)


def _damped(matrices: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "n 3 3"]:
    return matrices + (1e-9 * np.trace(matrices, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)


def _scattered(
    blocks: Float64[np.ndarray, "o 6 3"], image: np.ndarray, point: np.ndarray, images: int, points: int
) -> Float64[np.ndarray, "p s 3"]:
    """The sums of the blocks of each point and image, [points, 6 images, 3]."""
    table = np.zeros((points, images, 6, 3))
    np.add.at(table, (point, image), blocks)
    return table.reshape(points, 6 * images, 3)


def _moved(
    poses: Float64[np.ndarray, "o 4 4"], corrections: Float64[np.ndarray, "o 6"]
) -> Float64[np.ndarray, "o 4 4"]:
    """Poses behind corrections, whose turns are exact to the square of a milliradian."""
    x, y, z = corrections[:, 3:].T
    none = np.zeros_like(x)
    skew = np.stack((none, -z, y, z, none, -x, -y, x, none), 1).reshape(-1, 3, 3)
    turn = np.eye(3) + skew + 0.5 * skew @ skew
    moved = poses.copy()
    moved[:, :3] = turn @ poses[:, :3]
    moved[:, :3, 3] += corrections[:, :3]
    return moved
