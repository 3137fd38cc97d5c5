"""Brown-Conrady lens distortion of normalized image points (x = X/Z, y = Y/Z), with OpenCV's order of coefficients.

With r2 = x^2 + y^2 and radial = 1 + k1 r2 + k2 r2^2 + k3 r2^3 (Brown, "Close-range camera calibration", 1971):

    x_d = x radial + 2 p1 x y + p2 (r2 + 2 x^2)
    y_d = y radial + p1 (r2 + 2 y^2) + 2 p2 x y

A polynomial that was fitted inside an image does not describe the lens far outside of it. The radius r radial(r2) of
the distorted point grows only up to a certain r2, where it folds back; or it grows with r^7, beyond what float32 can
carry. From where its slope leaves (0, 4), here called the fold in both cases, the map is continued along each ray from
the center in proportion to the radius, D(x) = D(s x) / s with s x at the fold: it stays continuous, no point from far
outside lands in the image, and none lands more than 4 times as far out as a pinhole would put it.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_STEEPEST = 4.0
"""Largest d(r radial)/dr: lenses stay far below it."""
_NEWTON_STEPS = 30
_GRID = 65
"""Columns and rows of places where a shift is looked at, the border's among them."""


def fold_radius_squared(distortion: Float[Tensor, "5"]) -> float:
    """The smallest r2 > 0 where d(r radial)/dr = 1 + 3 k1 r2 + 5 k2 r2^2 + 7 k3 r2^3 is 0 or 4; inf if it never is."""
    k1, k2, _, _, k3 = distortion.tolist()
    # In v = 1 / r2 the leading coefficient is 1 - slope whatever the others are: no division by a small k3.
    roots = np.concatenate([np.roots([1 - slope, 3 * k1, 5 * k2, 7 * k3]) for slope in (0.0, _STEEPEST)])
    positive = roots.real[(np.abs(roots.imag) <= 1e-7 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / positive.max()) if len(positive) else math.inf


def distort(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2"]:
    """Where the lens images normalized points; differentiable in the points, not in the coefficients."""
    fold = fold_radius_squared(distortion)
    if math.isinf(fold):
        return _brown_conrady(points, distortion)
    shrink = (fold / points.square().sum(-1, keepdim=True).clamp(min=fold)).sqrt()
    return _brown_conrady(points * shrink, distortion) / shrink


def distortion_jacobian(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2 2"]:
    """d(x_d, y_d) / d(x, y), symmetric, for points before the fold."""
    k1, k2, p1, p2, k3 = distortion.tolist()
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    twice_slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    mixed = twice_slope * x * y + 2 * (p1 * x + p2 * y)
    xx = radial + twice_slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + twice_slope * y * y + 6 * p1 * y + 2 * p2 * x
    return torch.stack((xx, mixed, mixed, yy), -1).unflatten(-1, (2, 2))


@torch.no_grad()
def undistort(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2"]:
    """The inverse of :func:`distort`, by Newton's method in float64.

    Raises ValueError where no point is imaged there (tangential terms too strong for the model).
    """
    target = points.double()
    guess = target.clone()
    for _ in range(_NEWTON_STEPS):
        error = distort(guess, distortion) - target
        # Not solve(), whose error of a singular matrix is no ValueError.
        guess = guess - torch.linalg.solve_ex(_continued_jacobian(guess, distortion), error[..., None]).result[..., 0]
        if _found(error, target):  # before this step, which squares what was left
            break
    error = distort(guess, distortion) - target
    if not _found(error, target):
        raise ValueError(
            f"distorted points must have an inverse, but Newton's method is {float(error.abs().max()):.1e} off for "
            f"coefficients {distortion.tolist()}: check k1, k2, p1, p2, k3 against the calibration"
        )
    return guess.to(points.dtype)


def largest_shift(intrinsics: Float[Tensor, "3 3"], distortion: Float[Tensor, "5"], width: int, height: int) -> float:
    """Pixels between a place in the image and where a pinhole would show what the lens shows there, at most.

    Found on a grid that reaches to the image's border: the shift of a polynomial need not be largest there. Raises
    ValueError for a lens without an inverse in the image.
    """
    (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
    x = (torch.linspace(0, width, _GRID, dtype=torch.float64) - cx) / fx
    y = (torch.linspace(0, height, _GRID, dtype=torch.float64) - cy) / fy
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    shift = (undistort(places, distortion) - places) * torch.tensor([fx, fy], dtype=torch.float64)
    return float(shift.norm(dim=-1).max())


def _found(error: Float[Tensor, "*b 2"], target: Float[Tensor, "*b 2"]) -> bool:
    return bool((error.abs() < 1e-9 * (1 + target.abs())).all())


def _brown_conrady(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2"]:
    k1, k2, p1, p2, k3 = distortion.tolist()
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x_distorted = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_distorted = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return torch.stack((x_distorted, y_distorted), -1)


def _continued_jacobian(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2 2"]:
    """Jacobian of :func:`distort`. Past the fold, with n = x / |x| and R the fold's radius, it is
    J(R n) (I - n n^T) + D(R n) n^T / R."""
    fold = fold_radius_squared(distortion)
    if math.isinf(fold):
        return distortion_jacobian(points, distortion)
    radius = points.norm(dim=-1, keepdim=True)
    past = (radius > math.sqrt(fold))[..., None]
    normal = points / radius.clamp(min=math.sqrt(fold))
    edge = math.sqrt(fold) * normal
    across = torch.eye(2, dtype=points.dtype, device=points.device) - normal[..., :, None] * normal[..., None, :]
    along = _brown_conrady(edge, distortion)[..., :, None] * normal[..., None, :] / math.sqrt(fold)
    beyond = distortion_jacobian(edge, distortion) @ across + along
    return torch.where(past, beyond, distortion_jacobian(points, distortion))
