"""A Gaussian's footprint on the screen: its mean, and a factor V of its covariance V V^T (px^2).

For a pinhole V = J R S, 2x3, with the derivative J of the projection at the mean (EWA splatting, Zwicker et al. 2001).
With lens distortion V comes from the unscented transform, 2x7 (Julier and Uhlmann 1997; for splats 3DGUT, Wu et al.
2025).
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.geometry.lenses import distort, fold_radius_squared
from sparsestreet.types import Camera

Footprint = tuple[Float[Tensor, "v 2"], Float[Tensor, "v 2 k"]]


def pinhole(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], camera: Camera) -> Footprint:
    """Means, and V = J axes, with J at the row's mean and its slopes clamped to ``slope_limits``.

    Past the limit x/z has no derivative.
    """
    K, inverse_z, zero = camera.intrinsics.to(in_camera), 1 / in_camera[:, 2], torch.zeros_like(in_camera[:, 2])
    slopes = in_camera[:, :2] / in_camera[:, 2:]
    x, y = slopes.clamp(*slope_limits(camera, in_camera)).unbind(-1)
    row_x = torch.stack((K[0, 0] * inverse_z, zero, -K[0, 0] * x * inverse_z), -1)
    row_y = torch.stack((zero, K[1, 1] * inverse_z, -K[1, 1] * y * inverse_z), -1)
    return slopes * K.diagonal()[:2] + K[:2, 2], torch.stack((row_x, row_y), 1) @ axes


def slope_limits(camera: Camera, like: Tensor) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Least and largest x/z and y/z: -(cx/fx + 0.3 t) and (w - cx)/fx + 0.3 t with t = w / (2 fx), y likewise.

    It is the limit 1.3 tan(fov/2) of 3DGS, moved with the principal point.
    """
    K, size = camera.intrinsics.to(like), like.new_tensor([camera.width, camera.height])
    focal, center = K.diagonal()[:2], K[:2, 2]
    margin = 0.3 * size / (2 * focal)
    return -center / focal - margin, (size - center) / focal + margin


def slopes_held(in_camera: Float[Tensor, "v 3"], camera: Camera) -> Bool[Tensor, " v"]:
    """Rows whose Jacobian :func:`pinhole` takes at a limit instead of at their mean."""
    slopes = in_camera[:, :2] / in_camera[:, 2:]
    lowest, highest = slope_limits(camera, in_camera)
    return ((slopes < lowest) | (slopes > highest)).any(-1)


def unscented(
    in_camera: Float[Tensor, "v 3"],
    axes: Float[Tensor, "v 3 3"],
    camera: Camera,
    distortion: Float[Tensor, "5"],
    near: float,
) -> Footprint:
    """Mean and covariance of seven sigma points sent through projection and lens.

    With alpha = 1, beta = 2, kappa = 0 the points are mu and mu +- sqrt(3) a_k. mu has weight 0 in the mean and 2 in
    the
    covariance, the others 1/6 in both. No weight is negative, so V V^T is a covariance. The depth of a point nearer
    than ``near`` meters is set to ``near`` and has no derivative.
    """
    K = camera.intrinsics.to(in_camera)
    points = _sigma_points(in_camera, axes)
    normalized = points[..., :2] / points[..., 2:].clamp(min=near)
    # Relative to the principal point, because adding it would cost the differences digits.
    pixels = distort(normalized, distortion) * K.diagonal()[:2]
    centers = pixels[:, 1:].mean(1)
    weights = pixels.new_tensor([2.0] + [1 / 6] * 6)
    return centers + K[:2, 2], ((pixels - centers[:, None]) * weights.sqrt()[:, None]).mT


def sigma_points_held(
    in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"], distortion: Float[Tensor, "5"], near: float
) -> Bool[Tensor, " v"]:
    """Rows with a point that :func:`unscented` moves to ``near``, or that lies past the fold of the lens."""
    points = _sigma_points(in_camera, axes)
    slopes = points[..., :2] / points[..., 2:].clamp(min=near)
    past_fold = slopes.square().sum(-1) > fold_radius_squared(distortion)
    return (past_fold | (points[..., 2] < near)).any(-1)


def _sigma_points(in_camera: Float[Tensor, "v 3"], axes: Float[Tensor, "v 3 3"]) -> Float[Tensor, "v 7 3"]:
    steps = math.sqrt(3) * axes.mT
    return in_camera[:, None] + torch.cat((torch.zeros_like(steps[:, :1]), steps, -steps), 1)
