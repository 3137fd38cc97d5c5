"""Points triangulated from the training images."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from sparsestreet.scene.initialize.coverage import Coverage, beyond_lidar
from sparsestreet.scene.initialize.points import Points, thinned
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds, check_positive
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.triangulation import TriangulatedPoints


@dataclass(frozen=True, kw_only=True)
class ImagePoints(PointSource):
    """Points of static things.

    Raises ValueError for impossible settings.

    >>> ImagePoints().share(Coverage(lidar=0.5, images=0.25))
    0.25
    """

    order: Literal["beyond_first", "beyond_only", "random"] = "beyond_first"
    """Points to take: those beyond the lidar before the others, those beyond it alone, or any."""
    voxel: float | None = None
    """Side of a cube, meters, from which one point is taken; None: all points."""
    smallest_pixels: float = 0.5
    """Limits of a Gaussian's scale, in pixels of the view nearest to the point."""
    largest_pixels: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(voxel=self.voxel, smallest_pixels=self.smallest_pixels)
        if self.largest_pixels < self.smallest_pixels:
            raise ValueError(
                f"largest_pixels must be at least smallest_pixels, got {self.largest_pixels} and "
                f"{self.smallest_pixels}: raise the first or lower the second"
            )

    def share(self, coverage: Coverage) -> float:
        return coverage.images

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        if data.image_points is None:
            return self.seeds(Points.concatenate([]))
        found = data.image_points.static
        chosen = self._chosen(found, count, data, generator)
        points = Points(torch.from_numpy(found.positions), torch.from_numpy(found.colors)).at(chosen)
        pixel = torch.from_numpy(found.pixel_sizes)[chosen]
        return self.seeds(points, self.smallest_pixels * pixel, self.largest_pixels * pixel)

    def _chosen(
        self, found: TriangulatedPoints, count: int, data: TrainingData, generator: torch.Generator
    ) -> Int[Tensor, " k"]:
        if self.voxel is None:
            order = torch.randperm(len(found), generator=generator)
        else:
            order = thinned(torch.from_numpy(found.positions), self.voxel, generator)
        if self.order != "random":
            beyond = beyond_lidar(data, found)[order]
            rest = order[:0] if self.order == "beyond_only" else order[~beyond]
            order = torch.cat((order[beyond], rest))
        return order[:count]
