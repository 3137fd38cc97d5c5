"""A sphere seen through a pinhole: mirrors and fisheyes."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.geometry.lenses.lens import Lens, camera_matrix


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
        x, y, z = torch.nn.functional.normalize(directions, dim=-1).unbind(-1)
        x, y = x / (z + self.xi), y / (z + self.xi)
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * self.k2)
        column = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        row = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return torch.stack((self.gamma1 * column + self.u0, self.gamma2 * row + self.v0), -1)
