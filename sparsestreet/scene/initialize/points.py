"""Colored points."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Points:
    """Positions in meters and RGB in [0, 1]."""

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return self.positions.shape[0]

    def where(self, mask: Bool[Tensor, " n"]) -> "Points":
        return Points(self.positions[mask], self.colors[mask])

    def at(self, rows: Int[Tensor, " k"]) -> "Points":
        """Those of some rows, in that order."""
        return Points(self.positions[rows], self.colors[rows])

    def sampled(self, limit: int, generator: torch.Generator) -> "Points":
        """At most ``limit`` of the points, drawn without replacement."""
        return self.at(at_most(limit, torch.arange(len(self)), generator))

    @staticmethod
    def concatenate(parts: Sequence["Points"]) -> "Points":
        empty = torch.zeros(0, 3)
        return Points(
            torch.cat([empty, *(part.positions for part in parts)]),
            torch.cat([empty, *(part.colors for part in parts)]),
        )


def at_most(limit: int, rows: Int[Tensor, " n"], generator: torch.Generator) -> Int[Tensor, " k"]:
    """All rows where ``limit`` allows it, else so many of them, drawn without replacement."""
    return rows if len(rows) <= limit else rows[torch.randperm(len(rows), generator=generator)[:limit]]


def thinned(positions: Float[Tensor, "n 3"], voxel: float, generator: torch.Generator) -> Int[Tensor, " k"]:
    """Rows of one random point of each cube of side ``voxel`` meters, in random order."""
    order = torch.randperm(len(positions), generator=generator)
    cubes = (positions[order].double() / voxel).floor().long()
    distinct, cube = torch.unique(cubes, dim=0, return_inverse=True)
    # Of each cube the first of the random order.
    first = torch.full((len(distinct),), len(order)).scatter_reduce(0, cube, torch.arange(len(order)), "amin")
    return order[first.sort().values]
