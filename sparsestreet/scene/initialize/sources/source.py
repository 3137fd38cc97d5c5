"""The interface of the sources of points."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.scene.initialize.coverage import Coverage
from sparsestreet.scene.initialize.gaussians import MINIMUM_SCALE
from sparsestreet.scene.initialize.points import Points
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True)
class Seeds:
    """Points, and what their source knows about the Gaussians that start there."""

    points: Points
    smallest: Float[Tensor, " n"]
    """Limits of a Gaussian's scale, meters; between them the distance to its neighbors sets the scale."""
    largest: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    times: Float[Tensor, " n"]
    """Normalized time at which each point was measured; NaN if unknown."""
    normals: Float[Tensor, "n 3"]
    """Of the flat piece that a point lies in, unit length, z not negative; NaN if it lies in none, or unknown."""

    def __len__(self) -> int:
        return len(self.points)

    def where(self, mask: Bool[Tensor, " n"]) -> "Seeds":
        return Seeds(
            self.points.where(mask),
            self.smallest[mask],
            self.largest[mask],
            self.opacities[mask],
            self.times[mask],
            self.normals[mask],
        )

    @staticmethod
    def concatenate(parts: Sequence["Seeds"]) -> "Seeds":
        empty = torch.zeros(0)
        return Seeds(
            Points.concatenate([part.points for part in parts]),
            torch.cat([empty, *(part.smallest for part in parts)]),
            torch.cat([empty, *(part.largest for part in parts)]),
            torch.cat([empty, *(part.opacities for part in parts)]),
            torch.cat([empty, *(part.times for part in parts)]),
            torch.cat([torch.zeros(0, 3), *(part.normals for part in parts)]),
        )


@dataclass(frozen=True, kw_only=True)
class PointSource(ABC):
    """One source of initial points.

    Raises ValueError for impossible settings.
    """

    initial_opacity: float = 0.1
    number: int | None = None
    """How many points the source is asked for, whatever the images show; None: its share of the node's points."""

    def __post_init__(self) -> None:
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"initial_opacity must lie between 0 and 1, got {self.initial_opacity}: take 0.1")
        if self.number is not None and self.number < 0:
            raise ValueError(f"number must be >= 0, got {self.number}: 0 points, or null for a share of the node's")

    @abstractmethod
    def share(self, coverage: Coverage) -> float:
        """Returns the fraction of the node's points that the source is asked for if it has no ``number``.

        The fractions of a node's sources add up to 1 at most; the rest of the points is left out.
        """

    @abstractmethod
    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        """Returns ``count`` points, or all points if there are fewer."""

    def seeds(
        self,
        points: Points,
        smallest: Float[Tensor, " n"] | None = None,
        largest: Float[Tensor, " n"] | None = None,
        times: Float[Tensor, " n"] | None = None,
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> Seeds:
        """Returns seeds with the source's opacity; limits of the scale are meters (None: no limit on that side),
        ``times`` are normalized times of measurement, ``normals`` those of surfaces (None: unknown)."""
        count = len(points)
        return Seeds(
            points,
            torch.full((count,), MINIMUM_SCALE) if smallest is None else smallest,
            torch.full((count,), torch.inf) if largest is None else largest,
            torch.full((count,), self.initial_opacity),
            torch.full((count,), torch.nan) if times is None else times,
            torch.full((count, 3), torch.nan) if normals is None else normals,
        )


def check_positive(**values: float | None) -> None:
    """Raises ValueError for a setting that is not above 0; None passes."""
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be larger than 0, got {value}")
