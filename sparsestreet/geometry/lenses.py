"""Lenses of cameras: Brown-Conrady, its rational extension, fisheye, Mei and f-theta.

The lens distortion of normalized image points (x = X/Z, y = Y/Z) has OpenCV's order of coefficients.
With r2 = x^2 + y^2 and radial = 1 + k1 r2 + k2 r2^2 + k3 r2^3 (Brown, "Close-range camera calibration", 1971):

    x_d = x radial + 2 p1 x y + p2 (r2 + 2 x^2)
    y_d = y radial + p1 (r2 + 2 y^2) + 2 p2 x y

A polynomial that was fitted inside an image does not describe the lens far outside of it. The radius r radial(r2) of
the distorted point may fold back at some r2, or grow with r^7 beyond the range of float32. The fold is the smallest
radius where the slope of r radial(r2) leaves (0, 4). Beyond the fold the map continues along each ray from the center
in proportion to the radius: D(x) = D(s x) / s with s x at the fold. So the map is continuous, and no point from far
outside lands in the image. No point lands more than 4 times as far out as a pinhole would put it."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

RIGHT_ANGLE = math.pi / 2
_ANGLES = 1441
"""Of the polar grid on which folds are looked for: an eighth of a degree between them."""
_AZIMUTHS = 49


@dataclass(frozen=True)
class Lens(ABC):
    """A calibrated lens. Raises ValueError for numbers that are not finite, or focal lengths that are not positive."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not all(map(math.isfinite, numbers)):
                raise ValueError(f"{entry.name} of a lens must be finite, got {value}")
        focal = self.pinhole.diagonal()[:2]
        if not (focal > 0).all():
            raise ValueError(f"the focal lengths of a lens must be positive at its center, got {focal.tolist()}")

    @property
    @abstractmethod
    def pinhole(self) -> Float64[Tensor, "3 3"]:
        """Intrinsics of the pinhole that shows the center of the image at the same resolution."""

    @property
    def widest(self) -> float:
        """Largest angle from the optical axis, radians, that the model is made for."""
        return math.pi

    @abstractmethod
    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        """Pixels by the formula alone, wherever it leads; NaN where it has no value."""

    def brown_conrady(self) -> Float64[Tensor, "5"] | None:
        """k1, k2, p1, p2, k3 with which the splat op simulates the lens around ``pinhole``; None: it cannot."""
        return None

    def project(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        """Pixels, inside of the image or not; NaN for directions beyond ``reach``.

        >>> from sparsestreet.geometry.lenses import Fisheye
        >>> rays = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
        >>> Fisheye(fx=100.0, fy=100.0, cx=50.0, cy=50.0).project(rays)[:, 0].round(decimals=2).tolist()
        [50.0, 207.08]
        """
        seen = angles_from_axis(directions) <= self.reach
        return torch.where(seen[..., None], self.image(directions), torch.nan)

    @cached_property
    def reach(self) -> float:
        """Angle from the optical axis, radians, within which no pixel shows two directions: ``widest``, or at most a
        quarter of a degree before the image of a polar grid is turned over."""
        angles = torch.linspace(0, self.widest, _ANGLES, dtype=torch.float64)
        azimuths = torch.linspace(0, 2 * math.pi, _AZIMUTHS, dtype=torch.float64)
        at = self.image(_polar(angles[:, None], azimuths[None]))
        out, across = at[1:, 1:] - at[:-1, :-1], at[:-1, 1:] - at[1:, :-1]
        # Twice the signed area of each cell, as the cross product of its diagonals. A NaN compares false.
        outwards = (out[..., 0] * across[..., 1] - out[..., 1] * across[..., 0] > 0).all(1)
        folded = torch.nonzero(~outwards).flatten()
        # The fold itself may lie in the cell before, if that one grew more than it shrank.
        return self.widest if not len(folded) else float(angles[max(int(folded[0]) - 1, 0)])

    def check(self, width: int, height: int) -> None:
        """Raise ValueError for a lens that folds back inside of its image, less than 90 degrees from its axis.

        A pinhole sees no farther than that. Images of circular fisheyes have corners that show nothing.
        """
        if self.reach >= min(RIGHT_ANGLE, self.widest):
            return
        azimuths = torch.linspace(0, 2 * math.pi, _AZIMUTHS, dtype=torch.float64)
        column, row = self.image(_polar(torch.tensor(self.reach, dtype=torch.float64), azimuths)).unbind(-1)
        if ((column > 0) & (column < width) & (row > 0) & (row < height)).any():
            raise ValueError(
                f"a lens must image each direction at a pixel of its own, but this {type(self).__name__} folds back "
                f"{math.degrees(self.reach):.1f} degrees from its axis, inside of the {width}x{height} image: check "
                "its coefficients and their order against the calibration"
            )


def angles_from_axis(directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b"]:
    """Radians between directions and the optical axis, 0 to pi.

    >>> angles_from_axis(torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)).item()
    1.5707963267948966
    """
    return torch.atan2(torch.hypot(directions[..., 0], directions[..., 1]), directions[..., 2])


def sides(directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
    """Unit vectors in the image from the center towards each direction; zero on the axis.

    >>> sides(torch.tensor([3.0, 4.0, 7.0], dtype=torch.float64)).tolist()
    [0.6, 0.8]
    """
    return torch.nn.functional.normalize(directions[..., :2], dim=-1, eps=1e-300)


def _polar(angles: Float64[Tensor, "*#b"], azimuths: Float64[Tensor, "*#b"]) -> Float64[Tensor, "*#b 3"]:
    """Unit directions at these angles from the axis."""
    sine, cosine = torch.sin(angles), torch.cos(angles)
    rays = (sine * torch.cos(azimuths), sine * torch.sin(azimuths), cosine)
    return torch.stack(torch.broadcast_tensors(*rays), -1)


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64[Tensor, "3 3"]:
    """Return the matrix of a pinhole.

    >>> camera_matrix(100.0, 90.0, 32.0, 24.0).tolist()
    [[100.0, 0.0, 32.0], [0.0, 90.0, 24.0], [0.0, 0.0, 1.0]]
    """
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


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


@dataclass(frozen=True, kw_only=True)
class _Focal(Lens):
    """What all of OpenCV's models have."""

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def pinhole(self) -> Float64[Tensor, "3 3"]:
        return camera_matrix(self.fx, self.fy, self.cx, self.cy)

    def _pixels(self, x: Tensor, y: Tensor) -> Tensor:
        return torch.stack((self.fx * x + self.cx, self.fy * y + self.cy), -1)


@dataclass(frozen=True, kw_only=True)
class BrownConrady(_Focal):
    """OpenCV's five numbers (``geometry.lenses`` has the formula, and how it goes on past its fold); zeros are a
    pinhole. Its images and those of ``Rational`` end 90 degrees from the axis."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @staticmethod
    def of(intrinsics: Float64[Tensor, "3 3"], distortion: Float64[Tensor, "5"]) -> "BrownConrady":
        """From k1, k2, p1, p2, k3; what lies beside the diagonal of the camera matrix is left out."""
        k1, k2, p1, p2, k3 = distortion.tolist()
        (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
        return BrownConrady(fx=fx, fy=fy, cx=cx, cy=cy, k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)

    def brown_conrady(self) -> Float64[Tensor, "5"]:
        return torch.tensor([self.k1, self.k2, self.p1, self.p2, self.k3], dtype=torch.float64)

    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        return self._pixels(*distort(_slopes(directions), self.brown_conrady()).unbind(-1))

    @property
    def reach(self) -> float:
        """It goes on past its fold, so that nothing from there lands in the image."""
        return RIGHT_ANGLE


@dataclass(frozen=True, kw_only=True)
class Rational(_Focal):
    """OpenCV's rational model with thin prism (its documentation of ``calib3d``): with slopes x, y and r2 = x^2 + y^2

    radial = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    x_d = x radial + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
    y_d = y radial + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    @property
    def widest(self) -> float:
        return RIGHT_ANGLE - 1e-6

    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        x, y = _slopes(directions).unbind(-1)
        r2 = x * x + y * y
        radial = (1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / (
            1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        )
        x_distorted = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x) + r2 * (self.s1 + r2 * self.s2)
        y_distorted = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y + r2 * (self.s3 + r2 * self.s4)
        return self._pixels(x_distorted, y_distorted)

    def brown_conrady(self) -> Float64[Tensor, "5"] | None:
        if any((self.k4, self.k5, self.k6, self.s1, self.s2, self.s3, self.s4)):
            return None
        return torch.tensor([self.k1, self.k2, self.p1, self.p2, self.k3], dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class Fisheye(_Focal):
    """OpenCV's ``fisheye`` (Kannala and Brandt, "A generic camera model and calibration method", 2006): an image point
    lies theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) from the center, in focal lengths."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        theta = angles_from_axis(directions)
        t2 = theta * theta
        radius = theta * (1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        x, y = sides(directions).unbind(-1)
        return self._pixels(radius * x, radius * y)


def _slopes(directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
    """x / z and y / z; NaN for what is not ahead."""
    ahead = directions[..., 2:]
    return directions[..., :2] / torch.where(ahead > 0, ahead, torch.nan)


@dataclass(frozen=True, kw_only=True)
class Mei(Lens):
    """The unified omnidirectional model (Mei and Rives, "Single view point omnidirectional camera calibration from
    planar grids", 2007): of the unit direction, x = X / (Z + xi), y = Y / (Z + xi), then Brown-Conrady with k1, k2, p1,
    p2, then pixels (gamma1 x + u0, gamma2 y + v0). KITTI-360's fisheyes have it."""

    xi: float
    gamma1: float
    gamma2: float
    u0: float
    v0: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        if self.xi <= -1:
            raise ValueError(f"xi of a lens must be larger than -1, got {self.xi}: 0 is a pinhole")
        super().__post_init__()

    @property
    def pinhole(self) -> Float64[Tensor, "3 3"]:
        return camera_matrix(self.gamma1 / (1 + self.xi), self.gamma2 / (1 + self.xi), self.u0, self.v0)

    @property
    def widest(self) -> float:
        """Where Z + xi is 0, for xi below 1."""
        return math.acos(-self.xi) - 1e-6 if self.xi < 1 else math.pi

    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        unit = torch.nn.functional.normalize(directions, dim=-1)
        coefficients = torch.tensor([self.k1, self.k2, self.p1, self.p2, 0.0], dtype=torch.float64)
        column, row = _brown_conrady(unit[..., :2] / (unit[..., 2:] + self.xi), coefficients).unbind(-1)
        return torch.stack((self.gamma1 * column + self.u0, self.gamma2 * row + self.v0), -1)


@dataclass(frozen=True, kw_only=True)
class FTheta(Lens):
    """f-theta: a polynomial of the angle from the axis, in pixels, and a linear map [[c, d], [e, 1]] behind it.

    pixel = [[c, d], [e, 1]] radius(theta) (x, y) / hypot(x, y) + (cx, cy)
    """

    polynomial: tuple[float, ...]
    """Pixels by powers of theta, the constant first: the forward polynomial of NVIDIA's calibrations."""
    cx: float
    cy: float
    linear: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """c, d, e."""
    max_angle: float = math.pi
    """Radians from the axis that the polynomial was fitted to."""

    def __post_init__(self) -> None:
        if len(self.polynomial) < 2 or abs(self.polynomial[0]) > 1:
            raise ValueError(
                f"the polynomial of an f-theta lens starts at the center and has a slope, got {self.polynomial}: write "
                "the pixels of each power of the angle, from the constant on"
            )
        if not 0 < self.max_angle <= math.pi:
            raise ValueError(f"max_angle must lie within 0 and pi, radians, got {self.max_angle}")
        super().__post_init__()

    @property
    def pinhole(self) -> Float64[Tensor, "3 3"]:
        return camera_matrix(self.linear[0] * self.polynomial[1], self.polynomial[1], self.cx, self.cy)

    @property
    def widest(self) -> float:
        return self.max_angle

    def image(self, directions: Float64[Tensor, "*b 3"]) -> Float64[Tensor, "*b 2"]:
        theta = angles_from_axis(directions)
        radius = torch.zeros_like(theta)
        for coefficient in reversed(self.polynomial):
            radius = radius * theta + coefficient
        x, y = (radius[..., None] * sides(directions)).unbind(-1)
        c, d, e = self.linear
        return torch.stack((c * x + d * y + self.cx, e * x + y + self.cy), -1)
