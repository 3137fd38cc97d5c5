"""Points on the ground below the drive, as a source of its own."""

from dataclasses import dataclass

import torch

from sparsestreet.scene.initialize.gaussians import Points
from sparsestreet.scene.initialize.sources import PointSource, Seeds
from sparsestreet.scene.initialize.training_data import Coverage, TrainingData


@dataclass(frozen=True, kw_only=True)
class DrivenPoints(PointSource):
    """Gray points below the cameras of the training views, where the car has driven."""

    part: float
    height: float
    """Of the cameras above the ground, meters."""

    def share(self, coverage: Coverage) -> float:
        return self.part * coverage.nothing

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        cameras = torch.stack([view.camera.position for view in data.views])
        below = cameras[torch.randint(len(cameras), (count,), generator=generator)] - torch.tensor([0, 0, self.height])
        return self.seeds(Points(below, torch.full((count, 3), 0.5)), largest=torch.full((count,), 0.5))
