"""Computes where the rays of each point meet: linear least squares, then Gauss-Newton on the reprojection errors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int, Shaped

GAUSS_NEWTON_STEPS = 4
DAMPING = 1e-9
"""Added to the diagonal of the normal matrix, times its trace, because almost parallel rays leave it singular."""


@dataclass(frozen=True)
class Observations:
    """One row for each view of each point."""

    point: Int[np.ndarray, " o"]
    """Number of the point."""
    camera_from_frame: Float64[np.ndarray, "o 4 4"]
    rays: Float64[np.ndarray, "o 2"]
    """Normalized image points x/z, y/z."""
    focal: Float64[np.ndarray, " o"]
    """Pixels per unit of normalized image points."""

    def __len__(self) -> int:
        return len(self.rays)

    def where(self, rows: Bool[np.ndarray, " o"] | Int[np.ndarray, " k"]) -> "Observations":
        """The observations of a mask or of row numbers."""
        return Observations(self.point[rows], self.camera_from_frame[rows], self.rays[rows], self.focal[rows])

    def directions(self) -> tuple[Float64[np.ndarray, "o 3"], Float64[np.ndarray, "o 3"]]:
        """Camera centers and unit rays in the points' frame."""
        rotation, translation = self.camera_from_frame[:, :3, :3], self.camera_from_frame[:, :3, 3]
        centers = -np.einsum("oji,oj->oi", rotation, translation)
        local = np.concatenate((self.rays, np.ones((len(self), 1))), 1)
        rays = np.einsum("oji,oj->oi", rotation, local)
        return centers, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def meet(observations: Observations, count: int) -> Float64[np.ndarray, "n 3"]:
    """The position of least squared reprojection error of each point; the origin for a point without observations."""
    positions = _nearest_to_rays(observations, count)
    for _ in range(GAUSS_NEWTON_STEPS):
        residual, jacobian, _ = _reprojection(observations, positions)
        normal = summed(np.einsum("oki,okj->oij", jacobian, jacobian), observations.point, count)
        slope = summed(np.einsum("oki,ok->oi", jacobian, residual), observations.point, count)
        positions = positions - _solved(normal, slope)
    return positions


def reprojection_errors(
    observations: Observations, positions: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " o"], Float64[np.ndarray, " o"]]:
    """(error in pixels, depth in meters) of each observation; a point behind the camera has a negative depth."""
    residual, _, depth = _reprojection(observations, positions)
    return np.linalg.norm(residual, axis=1), depth


def relative_depth_error(
    observations: Observations, positions: Float64[np.ndarray, "n 3"], noise: float
) -> Float64[np.ndarray, " n"]:
    """Standard deviation of a point along its least certain direction over its distance from the nearest camera.

    The covariance is noise^2 (J^T J)^-1 with the Jacobian J of the reprojection; ``noise`` is the standard deviation of
    a feature in pixels. Unlike the angle between two rays, it counts many views of small parallax.
    """
    count = len(positions)
    _, jacobian, _ = _reprojection(observations, positions)
    normal = summed(np.einsum("oki,okj->oij", jacobian, jacobian), observations.point, count)
    weakest = np.linalg.eigvalsh(normal)[:, 0]
    centers, _ = observations.directions()
    distance = np.full(count, np.inf)
    np.minimum.at(distance, observations.point, np.linalg.norm(positions[observations.point] - centers, axis=1))
    return np.where(weakest > 0, noise / np.sqrt(np.maximum(weakest, 1e-300)) / distance, np.inf)


def _nearest_to_rays(observations: Observations, count: int) -> Float64[np.ndarray, "n 3"]:
    """Solves sum (I - d d^T) x = sum (I - d d^T) c over the rays c + s d."""
    centers, rays = observations.directions()
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = summed(across, observations.point, count)
    target = summed(np.einsum("oij,oj->oi", across, centers), observations.point, count)
    return _solved(normal, target)


def _reprojection(
    observations: Observations, positions: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "o 2"], Float64[np.ndarray, "o 2 3"], Float64[np.ndarray, " o"]]:
    """Residuals in pixels, their derivative with respect to the point, and depths."""
    rotation = observations.camera_from_frame[:, :3, :3]
    local = np.einsum("oij,oj->oi", rotation, positions[observations.point]) + observations.camera_from_frame[:, :3, 3]
    depth = local[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    projected = local[:, :2] / safe[:, None]
    residual = (projected - observations.rays) * observations.focal[:, None]
    jacobian = (rotation[:, :2] - projected[:, :, None] * rotation[:, 2:]) * (observations.focal / safe)[:, None, None]
    return residual, jacobian, depth


def summed(
    values: Shaped[np.ndarray, " o *s"], point: Int[np.ndarray, " o"], count: int
) -> Float64[np.ndarray, " n *s"]:
    """The sum over the observations of each point."""
    sums = np.zeros((count, *values.shape[1:]))
    for place in np.ndindex(*values.shape[1:]):
        sums[:, *place] = np.bincount(point, weights=values[:, *place], minlength=count)
    return sums


def _solved(matrix: Float64[np.ndarray, "n 3 3"], right: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    damping = DAMPING * np.trace(matrix, axis1=1, axis2=2) + 1e-12
    return np.linalg.solve(matrix + damping[:, None, None] * np.eye(3), right[:, :, None])[:, :, 0]
