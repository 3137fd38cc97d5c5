"""Renderers and measurements that share no code with the package."""

from collections.abc import Iterable

import numpy as np
from torch import Tensor

from sparsestreet.ops import SplatSettings
from sparsestreet.types import Camera, Gaussians
from tests.ops.scenes import FIELDS


def naive_image(
    gaussians: Gaussians,
    view: Camera,
    settings: SplatSettings,
    rows: Iterable[int] | None = None,
    columns: Iterable[int] | None = None,
) -> np.ndarray:
    """Per pixel, from the textbook: matrix inverse of the covariance, no tricks; pinhole, degree 0 colors.

    Image rows and columns that are not asked for stay black.
    """
    splats = sorted(_naive_splats(gaussians, view, settings), key=lambda item: item[0])
    image = np.zeros((view.height, view.width, 3))
    for row in range(view.height) if rows is None else rows:
        for column in range(view.width) if columns is None else columns:
            passed = 1.0
            for _, mean, conic, opacity, color, _ in splats:
                d = np.array([column + 0.5, row + 0.5]) - mean
                alpha = min(settings.alpha_max, opacity * np.exp(-0.5 * d @ conic @ d))
                if alpha < settings.alpha_min or passed <= settings.transmittance_min:
                    continue
                image[row, column] += passed * alpha * color
                passed *= 1 - alpha
    return image


def naive_median_depth(
    gaussians: Gaussians, view: Camera, settings: SplatSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel the depth and row of the splat behind which at most half of the light is left, and what it and
    those before it cover; infinite and -1 where more is left."""
    splats = sorted(_naive_splats(gaussians, view, settings), key=lambda item: item[0])
    depth, covered = np.full((view.height, view.width), np.inf), np.zeros((view.height, view.width))
    found = np.full(depth.shape, -1)
    for row, column in np.ndindex(depth.shape):
        passed = 1.0
        for z, mean, conic, opacity, _, number in splats:
            d = np.array([column + 0.5, row + 0.5]) - mean
            alpha = min(settings.alpha_max, opacity * np.exp(-0.5 * d @ conic @ d))
            passed *= 1 - (alpha if alpha >= settings.alpha_min else 0.0)
            covered[row, column] = 1 - passed
            if passed <= 0.5:
                depth[row, column], found[row, column] = z, number
                break
    return depth, found, covered


def _naive_splats(gaussians: Gaussians, view: Camera, settings: SplatSettings) -> list[tuple]:
    pose, intrinsics = view.camera_from_world.double().numpy(), view.intrinsics.double().numpy()
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    splats = []
    fields = (getattr(gaussians, name).numpy() for name in FIELDS)
    for number, (mean, q, scale, opacity, sh) in enumerate(zip(*fields, strict=True)):
        x, y, z = pose[:3, :3] @ mean + pose[:3, 3]
        if z <= settings.near_plane:
            continue
        margin_x, margin_y = 0.15 * view.width / fx, 0.15 * view.height / fy
        u = np.clip(x / z, -cx / fx - margin_x, (view.width - cx) / fx + margin_x)
        v = np.clip(y / z, -cy / fy - margin_y, (view.height - cy) / fy + margin_y)
        jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
        half = jacobian @ pose[:3, :3] @ rotation_matrix(q) @ np.diag(scale)
        conic = np.linalg.inv(half @ half.T + settings.eps2d * np.eye(2))
        color = np.maximum(0, 0.5 + sh[0] / (2 * np.sqrt(np.pi)))
        splats.append((z, np.array([fx * x / z + cx, fy * y / z + cy]), conic, opacity, color, number))
    return splats


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Of a quaternion wxyz of any length, by Rodrigues' formula."""
    w, i, j, k = q / np.linalg.norm(q)
    skew = np.array([[0, -k, j], [k, 0, -i], [-j, i, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def brown_conrady(x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Where a lens k1, k2, p1, p2, k3 shows normalized coordinates; [.., 2]."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.stack((x_d, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y), -1)


def fitted_splat(alpha: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance, in pixels, of the one splat that made this float64 image (no cut-off, no clamp acting).

    Its log is exactly quadratic in the pixel: six coefficients by least squares.
    """
    height, width = alpha.shape
    y, x = (axis.ravel() + 0.5 for axis in np.mgrid[:height, :width])
    # 1 - T keeps few digits of the faint pixels: they are left out, and the others weigh as they are bright.
    kept = alpha.numpy().ravel() > 1e-6
    weight, x, y = alpha.numpy().ravel()[kept], x[kept], y[kept]
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), -1)
    solution, *_ = np.linalg.lstsq(terms * weight[:, None], np.log(weight) * weight, rcond=None)
    _, bx, by, xx, xy, yy = solution
    precision = -np.array([[2 * xx, xy], [xy, 2 * yy]])
    covariance = np.linalg.inv(precision)
    return covariance @ np.array([bx, by]), covariance
