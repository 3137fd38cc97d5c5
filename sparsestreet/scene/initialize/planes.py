"""Flat pieces of a street: where lidar returns lie in a plane, and which way it faces."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

SIDE = 0.5
"""Meters; a plane is fitted to the returns in each cube. 1 m bridges curbs: 0.25 dB less at 3 m beside the path
(docs/moved_views.md)."""
THICKNESS = 0.05
"""Meters; returns whose distances from their plane have a larger standard deviation lie in none. Lidars have 2 cm,
poses as much."""
FEWEST = 10
"""Returns a plane is fitted to."""
NARROWEST = 0.2
"""Times what a filled cube has: a smaller standard deviation along the plane is that of a line, such as one beam's."""
_OFFSET = 1 << 20
"""Cubes are counted from -2^20 to 2^20 along each axis, 500 km at 0.5 m."""


@dataclass(frozen=True)
class Planes:
    """The flat pieces, at most one a cube; their cubes in increasing order."""

    cubes: Int[Tensor, " c"]
    centers: Float[Tensor, "c 3"]
    """A point of each plane, world, meters."""
    normals: Float[Tensor, "c 3"]
    """Unit length; z is not negative."""

    def onto(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """The points, those in a cube with a plane moved to the nearest place on it, and its normal; NaN without."""
        cubes = _cubes(points)
        rows = torch.searchsorted(self.cubes, cubes)
        rows = torch.where(rows < len(self.cubes), rows, 0)
        at = torch.nonzero(torch.isin(cubes, self.cubes)).squeeze(-1)
        normals, centers = self.normals[rows[at]], self.centers[rows[at]]
        above = ((points[at] - centers) * normals).sum(1, keepdim=True)
        nowhere = torch.full_like(points, torch.nan)
        return points.index_copy(0, at, points[at] - above * normals), nowhere.index_copy(0, at, normals)


def fit_planes(points: Float[Tensor, "n 3"]) -> Planes:
    """The planes that minimize the squared distances of the points in each cube: eigenvectors of their covariance.

    >>> along = torch.arange(16.0) / 40
    >>> floor = torch.cartesian_prod(along, along, torch.tensor([0.1]))
    >>> fit_planes(floor).normals.abs().round(decimals=3).tolist()
    [[0.0, 0.0, 1.0]]
    """
    cubes, cube, counts = torch.unique(_cubes(points), return_inverse=True, return_counts=True)
    centers = torch.zeros(len(cubes), 3, dtype=torch.float64).index_add_(0, cube, points.double()) / counts[:, None]
    offsets = points.double() - centers[cube]
    products = (offsets[:, :, None] * offsets[:, None, :]).flatten(1)
    sums = torch.zeros(len(cubes), 9, dtype=torch.float64).index_add_(0, cube, products)
    variances, axes = torch.linalg.eigh((sums / counts[:, None]).view(-1, 3, 3))
    thin = variances[:, 0] < THICKNESS**2
    wide = variances[:, 1] > NARROWEST**2 * SIDE**2 / 12
    flat = (counts >= FEWEST) & thin & wide
    normals = axes[flat, :, 0]
    normals = torch.where(normals[:, 2:] < 0, -normals, normals)
    return Planes(cubes[flat], centers[flat].float(), normals.float())


def _cubes(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """One number for each cube."""
    places = (points.double() / SIDE).floor().long() + _OFFSET
    return (places[:, 0] << 42) | (places[:, 1] << 21) | places[:, 2]
