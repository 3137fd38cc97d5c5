"""Points triangulated from the training images, and those that came with the log."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.scene.initialize.coverage import Coverage, beyond_lidar
from sparsestreet.scene.initialize.points import Points, at_most, thinned
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds, check_positive
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.triangulation import TriangulatedPoints
from sparsestreet.types import View


@dataclass(frozen=True, kw_only=True)
class ImagePoints(PointSource):
    """Points of static things: those that the run triangulates, and those of the log (``DrivingLog.sparse_points``).

    Raises ValueError for impossible settings.

    >>> ImagePoints().share(Coverage(lidar=0.5, images=0.25))
    0.25
    """

    initial_opacity: float = 0.5
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
        points, pixel = Points.concatenate([]), torch.zeros(0)
        if data.image_points is not None:
            found = data.image_points.static
            chosen = self._chosen(found, count, data, generator)
            points = Points(torch.from_numpy(found.positions), torch.from_numpy(found.colors)).at(chosen)
            pixel = torch.from_numpy(found.pixel_sizes)[chosen]
        if data.log.sparse_points is not None:
            points, pixel = self._with_sparse(points, pixel, count, data, generator)
        return self.seeds(points, self.smallest_pixels * pixel, self.largest_pixels * pixel)

    def _with_sparse(
        self, points: Points, pixel: Float[Tensor, " n"], count: int, data: TrainingData, generator: torch.Generator
    ) -> tuple[Points, Float[Tensor, " k"]]:
        """Any ``count`` of the points, whose pixels' sizes are given, and those of the log."""
        assert data.log.sparse_points is not None
        sparse = data.log.sparse_points()
        rows = torch.arange(len(sparse)) if self.voxel is None else thinned(sparse.positions, self.voxel, generator)
        both = Points.concatenate([points, Points(sparse.positions, sparse.colors).at(rows)])
        sizes = torch.cat((pixel, pixel_sizes(sparse.positions[rows], data.views)))
        chosen = at_most(count, torch.arange(len(both)), generator)
        return both.at(chosen), sizes[chosen]

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


def pixel_sizes(positions: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, " n"]:
    """Returns the sizes of a pixel at some points, meters, as the nearest camera sees them."""
    cameras = torch.stack([view.camera.position for view in views]).double().numpy()
    focal = torch.tensor([float(view.camera.intrinsics[0, 0]) for view in views])
    distances, nearest = KDTree(cameras).query(positions.double().numpy())
    return torch.from_numpy(distances).float() / focal[torch.from_numpy(nearest)]
