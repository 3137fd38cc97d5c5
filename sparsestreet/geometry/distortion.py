"""Brown-Conrady lens distortion of normalized image points (x = X/Z, y = Y/Z), with OpenCV's order of coefficients.

With r2 = x^2 + y^2 and radial = 1 + k1 r2 + k2 r2^2 + k3 r2^3 (Brown, "Close-range camera calibration", 1971):

    x_d = x radial + 2 p1 x y + p2 (r2 + 2 x^2)
    y_d = y radial + p1 (r2 + 2 y^2) + 2 p2 x y

A polynomial that was fitted inside an image does not describe the lens far outside of it. The radius r radial(r2) of
the distorted point may fold back at some r2, or grow with r^7 beyond the range of float32. The fold is the smallest
radius where the slope of r radial(r2) leaves (0, 4). Beyond the fold the map continues along each ray from the center
in proportion to the radius: D(x) = D(s x) / s with s x at the fold. So the map is continuous, and no point from far
outside lands in the image. No point lands more than 4 times as far out as a pinhole would put it.
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
"""Columns and rows of the grid on which shifts are computed, the image's border included."""


def fold_radius_squared(distortion: Float[Tensor, "5"]) -> float:
    """The smallest r2 > 0 where d(r radial)/dr = 1 + 3 k1 r2 + 5 k2 r2^2 + 7 k3 r2^3 is 0 or 4; inf if it never is.

    >>> fold_radius_squared(torch.tensor([-0.25, 0.0, 0.0, 0.0, 0.0]))  # 1 - 0.75 r2 = 0
    1.3333...
    """
    k1, k2, _, _, k3 = distortion.tolist()
    # In v = 1 / r2 the leading coefficient is always 1 - slope, so nothing is divided by a small k3.
    roots = np.concatenate([np.roots([1 - slope, 3 * k1, 5 * k2, 7 * k3]) for slope in (0.0, _STEEPEST)])
    positive = roots.real[(np.abs(roots.imag) <= 1e-7 * np.abs(roots)) & (roots.real > 0)]
    return float(1 / positive.max()) if len(positive) else math.inf


def distort(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2"]:
    """Normalized image points as the lens shows them; differentiable in the points, not in the coefficients.

    >>> barrel = torch.tensor([-0.25, 0.0, 0.0, 0.0, 0.0])
    >>> distort(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), barrel).tolist()  # the second: 1 - 0.25
    [[0.0, 0.0], [0.75, 0.0]]
    """
    fold = fold_radius_squared(distortion)
    if math.isinf(fold):
        return _brown_conrady(points, distortion)
    shrink = (fold / points.square().sum(-1, keepdim=True).clamp(min=fold)).sqrt()
    return _brown_conrady(points * shrink, distortion) / shrink


def distortion_jacobian(points: Float[Tensor, "*b 2"], distortion: Float[Tensor, "5"]) -> Float[Tensor, "*b 2 2"]:
    """Symmetric derivatives d(x_d, y_d) / d(x, y) of points inside the fold.

    >>> distortion_jacobian(torch.tensor([1.0, 0.0]), torch.tensor([-0.25, 0.0, 0.0, 0.0, 0.0])).tolist()
    [[0.25, 0.0], [0.0, 0.75]]
    """
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

    Raises ValueError if the lens maps no point there (tangential terms too strong for the model).

    >>> undistort(torch.tensor([0.75, 0.0]), torch.tensor([-0.25, 0.0, 0.0, 0.0, 0.0])).tolist()
    [1.0, 0.0]
    """
    target = points.double()
    guess = target.clone()
    for _ in range(_NEWTON_STEPS):
        error = distort(guess, distortion) - target
        # solve() would raise another error than ValueError for a singular matrix.
        guess = guess - torch.linalg.solve_ex(_continued_jacobian(guess, distortion), error[..., None]).result[..., 0]
        if _found(error, target):  # the error before this step, which squared it
            break
    error = distort(guess, distortion) - target
    if not _found(error, target):
        raise ValueError(
            f"distorted points must have an inverse, but Newton's method is {float(error.abs().max()):.1e} off for "
            f"coefficients {distortion.tolist()}: check k1, k2, p1, p2, k3 against the calibration"
        )
    return guess.to(points.dtype)


def largest_shift(intrinsics: Float[Tensor, "3 3"], distortion: Float[Tensor, "5"], width: int, height: int) -> float:
    """The largest distance, in pixels, between what the lens shows and where a pinhole would show it.

    The search covers a grid over the whole image, because a polynomial may shift most away from the border. Raises
    ValueError for a lens without an inverse in the image.

    >>> intrinsics = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
    >>> largest_shift(intrinsics, torch.tensor([-0.1, 0.0, 0.0, 0.0, 0.0]), width=100, height=100)
    4.20...
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
