"""A polynomial of the angle, in pixels."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.geometry.lenses.lens import Lens, angles_from_axis, camera_matrix, sides


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
