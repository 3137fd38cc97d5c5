"""Real spherical harmonics to degree 3, in the order and with the signs that 3DGS files use."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FIRST = 0.5 / math.sqrt(math.pi)
"""Value of the harmonic of degree 0."""


def of_colors(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Return the harmonics of degree 0 that show these colors from everywhere.

    >>> of_colors(torch.full((1, 3), 0.5))
    tensor([[[0., 0., 0.]]])
    """
    return ((colors - 0.5) / FIRST)[:, None]


def basis(directions: Float[Tensor, "n 3"], terms: int) -> Float[Tensor, "n k"]:
    """The first ``terms`` (1, 4, 9 or 16) basis functions at unit directions.

    Sloan, "Stupid Spherical Harmonics Tricks" (2008), appendix A2, in Cartesian form with Condon-Shortley signs.
    """
    x, y, z = directions.unbind(-1)
    pi = math.pi
    values = [torch.full_like(x, FIRST)]
    if terms > 1:
        first = math.sqrt(3 / (4 * pi))
        values += [-first * y, first * z, -first * x]
    if terms > 4:
        mixed, zonal, planar = math.sqrt(15 / pi) / 2, math.sqrt(5 / pi) / 4, math.sqrt(15 / pi) / 4
        values += [
            mixed * x * y,
            -mixed * y * z,
            zonal * (2 * z * z - x * x - y * y),
            -mixed * x * z,
            planar * (x * x - y * y),
        ]
    if terms > 9:
        outer, corner, middle = math.sqrt(35 / (2 * pi)) / 4, math.sqrt(105 / pi) / 2, math.sqrt(21 / (2 * pi)) / 4
        zonal, planar = math.sqrt(7 / pi) / 4, math.sqrt(105 / pi) / 4
        values += [
            -outer * y * (3 * x * x - y * y),
            corner * x * y * z,
            -middle * y * (4 * z * z - x * x - y * y),
            zonal * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -middle * x * (4 * z * z - x * x - y * y),
            planar * z * (x * x - y * y),
            -outer * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)


def view_colors(
    sh: Float[Tensor, "n k 3"], directions: Float[Tensor, "n 3"], clamped: bool = False
) -> Float[Tensor, "n 3"]:
    """Colors 0.5 + sum_i basis_i(direction) sh_i along directions of any non-zero length, camera to Gaussian.

    They are kept from falling below 0, or ``clamped`` to [0, 1]. Gradients go to coefficients and directions. They are
    zero below 0 and, if clamped, above 1; a color of exactly 0 has one only if clamped, as torch's clamp gives it.
    """
    unit = directions / directions.norm(dim=-1, keepdim=True)
    colors = 0.5 + (basis(unit, sh.shape[1])[..., None] * sh).sum(1)
    return colors.clamp(0, 1) if clamped else torch.where(colors > 0, colors, 0.0)
