"""OpenCV's models: Brown-Conrady, its rational extension, and the fisheye."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.geometry.distortion import distort
from sparsestreet.geometry.lenses.lens import RIGHT_ANGLE, Lens, angles_from_axis, camera_matrix, sides


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
    """OpenCV's five numbers (``geometry.distortion`` has the formula, and how it goes on past its fold); zeros are a
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
