"""Lidar returns that do not belong to a moving object."""

from dataclasses import dataclass

import torch

from sparsestreet.scene.initialize.boxes import outside_boxes
from sparsestreet.scene.initialize.coverage import Coverage
from sparsestreet.scene.initialize.planes import fit_planes
from sparsestreet.scene.initialize.points import Points, at_most, thinned
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds, check_positive
from sparsestreet.scene.initialize.training_data import TrainingData


@dataclass(frozen=True, kw_only=True)
class LidarPoints(PointSource):
    """Colored returns of the training sweeps, outside all moving boxes of their instant if ``box_enlargement`` is set.

    Raises ValueError for impossible settings.
    """

    box_enlargement: float | None = 1.1
    """Factor on the sides of a moving object's box, because points may lie just outside an imprecise box; None: returns
    from moving objects are taken too."""
    voxel: float | None = None
    """Side of a cube, meters, from which one return is taken; None: all returns."""
    flat: bool = True
    """Whether a return on a road or wall starts in its plane, as a thin disk; False: as a ball, like all others."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(box_enlargement=self.box_enlargement, voxel=self.voxel)

    def share(self, coverage: Coverage) -> float:
        return coverage.lidar

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        parts, instants = [], [torch.zeros(0)]
        for sweep in data.sweeps:
            taken = sweep.colored
            if self.box_enlargement is not None:
                taken = taken & outside_boxes(data.moving, sweep, self.box_enlargement)
            parts.append(Points(sweep.points, sweep.colors).where(taken))
            instants.append(torch.full((len(parts[-1]),), sweep.time))
        points = Points.concatenate(parts)
        rows = torch.arange(len(points)) if self.voxel is None else thinned(points.positions, self.voxel, generator)
        chosen = at_most(count, rows, generator)
        taken, normals = points.at(chosen), None
        if self.flat:
            positions, normals = fit_planes(points.positions).onto(taken.positions)
            taken = Points(positions, taken.colors)
        return self.seeds(taken, times=torch.cat(instants)[chosen], normals=normals)
