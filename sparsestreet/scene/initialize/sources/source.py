"""What every source of points has in common."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.scene.initialize.coverage import Coverage
from sparsestreet.scene.initialize.gaussians import MINIMUM_SCALE
from sparsestreet.scene.initialize.points import Points
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True)
class Seeds:
    """Points, and what their source knows of the Gaussians that start there."""

    points: Points
    smallest: Float[Tensor, " n"]
    """Limits of a Gaussian's scale, meters; between them the distance to its neighbors decides."""
    largest: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    times: Float[Tensor, " n"]
    """Normalized time at which each was measured; NaN where it is known of no time."""

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def concatenate(parts: Sequence["Seeds"]) -> "Seeds":
        empty = torch.zeros(0)
        return Seeds(
            Points.concatenate([part.points for part in parts]),
            torch.cat([empty, *(part.smallest for part in parts)]),
            torch.cat([empty, *(part.largest for part in parts)]),
            torch.cat([empty, *(part.opacities for part in parts)]),
            torch.cat([empty, *(part.times for part in parts)]),
        )


@dataclass(frozen=True, kw_only=True)
class PointSource(ABC):
    """One source of initial points.

    Raises ValueError for settings that cannot be.
    """

    initial_opacity: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"initial_opacity must lie between 0 and 1, got {self.initial_opacity}: take 0.1")

    @abstractmethod
    def share(self, coverage: Coverage) -> float:
        """The fraction of the node's points that the source is asked for.

        Those of a node's sources add up to 1 at most; what none of them asks for is left out.
        """

    @abstractmethod
    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        """``count`` points, or all there are."""

    def seeds(
        self,
        points: Points,
        smallest: Float[Tensor, " n"] | None = None,
        largest: Float[Tensor, " n"] | None = None,
        times: Float[Tensor, " n"] | None = None,
    ) -> Seeds:
        """Points with the source's opacity; limits of the scale in meters, None: none on that side; normalized times
        of their measurement, None: not known."""
        count = len(points)
        return Seeds(
            points,
            torch.full((count,), MINIMUM_SCALE) if smallest is None else smallest,
            torch.full((count,), torch.inf) if largest is None else largest,
            torch.full((count,), self.initial_opacity),
            torch.full((count,), torch.nan) if times is None else times,
        )


def check_positive(**values: float | None) -> None:
    """Raises ValueError for a setting that is not above 0; None passes."""
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be larger than 0, got {value}")
