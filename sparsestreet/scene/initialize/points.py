"""Colored points."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Points:
    """Positions in meters and RGB in [0, 1].

    >>> points = Points(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.ones(2, 3))
    >>> len(points.where(points.positions[:, 0] > 0.5))
    1
    """

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return self.positions.shape[0]

    def where(self, mask: Bool[Tensor, " n"]) -> "Points":
        return Points(self.positions[mask], self.colors[mask])

    def at(self, rows: Int[Tensor, " k"]) -> "Points":
        """Returns the points of some rows, in that order."""
        return Points(self.positions[rows], self.colors[rows])

    def sampled(self, limit: int, generator: torch.Generator) -> "Points":
        """Returns at most ``limit`` of the points, drawn without replacement."""
        return self.at(at_most(limit, torch.arange(len(self)), generator))

    @staticmethod
    def concatenate(parts: Sequence["Points"]) -> "Points":
        empty = torch.zeros(0, 3)
        return Points(
            torch.cat([empty, *(part.positions for part in parts)]),
            torch.cat([empty, *(part.colors for part in parts)]),
        )


def at_most(limit: int, rows: Int[Tensor, " n"], generator: torch.Generator) -> Int[Tensor, " k"]:
    """Returns all rows if there are at most ``limit``, else ``limit`` of them, drawn without replacement.

    >>> len(at_most(2, torch.arange(5), torch.Generator().manual_seed(0)))
    2
    """
    return rows if len(rows) <= limit else rows[torch.randperm(len(rows), generator=generator)[:limit]]


def thinned(positions: Float[Tensor, "n 3"], voxel: float, generator: torch.Generator) -> Int[Tensor, " k"]:
    """Returns the rows of one random point of each cube with side ``voxel`` meters, in random order.

    >>> positions = torch.tensor([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [1.5, 0.0, 0.0]])
    >>> len(thinned(positions, 1.0, torch.Generator().manual_seed(0)))
    2
    """
    order = torch.randperm(len(positions), generator=generator)
    cubes = (positions[order].double() / voxel).floor().long()
    distinct, cube = torch.unique(cubes, dim=0, return_inverse=True)
    # Take the first point of each cube in the random order.
    first = torch.full((len(distinct),), len(order)).scatter_reduce(0, cube, torch.arange(len(order)), "amin")
    return order[first.sort().values]
