"""Everything that does not move: where it starts, and what it answers."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.coverage import coverage
from sparsestreet.scene.initialize.gaussians import neighbor_scales
from sparsestreet.scene.initialize.sources import PointSource, Seeds
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Gaussians, View

_log = logging.getLogger(__name__)
@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(NodeSettings):
    """Starts from what its sources give."""

    num_points: int
    """All sources together; each takes its share by what the training images show."""
    sources: Mapping[str, PointSource]

    def build(self, data: TrainingData, generator: torch.Generator) -> "Background":
        """Raises ValueError if there is not a single point to start from."""
        seen = coverage(data)
        drawn = {
            name: source.draw(round(self.num_points * source.share(seen)), data, generator)
            for name, source in self.sources.items()
        }
        _log.info(
            "the lidar covers %.0f %% of the pixels that are not sky, images %.0f %% more; points from %s",
            100 * seen.lidar,
            100 * seen.images,
            ", ".join(f"{name}: {len(seeds)}" for name, seeds in drawn.items()),
        )
        seeds = Seeds.concatenate(list(drawn.values()))
        if len(seeds) == 0:
            raise ValueError(
                f"the background of {data.log.name!r} has nothing to start from: its sources ({', '.join(drawn)}) give "
                f"no point that one of {len(data.frames)} training views sees; raise num_points, add a source, or check "
                "the poses of the cameras"
            )
        scales = neighbor_scales(seeds.points.positions).clamp(seeds.smallest, seeds.largest)
        rows, mask = self.start(data, seeds.points, scales, seeds.opacities, generator)
        return Background(self, rows, mask)

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Background":
        return Background(self, rows)


class Background(Node):
    """Static Gaussians; their rows are in the world frame already."""

    def gaussians_at(self, view: View, state: SceneState) -> Gaussians:
        """The same Gaussians in every view, activated, with the mask applied."""
        return self.activated(view, state)
