"""People as clouds that bob up and down: one module and one yaml make a node type."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.gaussians import Points, neighbor_scales
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes import Instances, Node, NodeSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View


@dataclass(frozen=True, kw_only=True)
class BobbingSettings(NodeSettings):
    """Starts with random points in the first box of each track."""

    points_per_instance: int
    initial_opacity: float = 0.5
    stillness: float = 0.1
    """Weight of the regularizer."""

    def build(self, data: TrainingData, generator: torch.Generator) -> "Bobbing | None":
        if not data.tracks:
            return None
        parts = [
            (torch.rand(self.points_per_instance, 3, generator=generator) - 0.5) * track.size
            + track.world_from_object[0, :3, 3].float()
            for track in data.tracks
        ]
        points = Points(torch.cat(parts), torch.full((len(parts) * self.points_per_instance, 3), 0.5))
        instances = torch.arange(len(parts)).repeat_interleave(self.points_per_instance)
        rows, mask = self.start(
            data,
            points,
            neighbor_scales(points.positions),
            torch.full((len(points),), self.initial_opacity),
            generator,
            buffers={"instances": instances},
        )
        return Bobbing(self, rows, tuple(track.name for track in data.tracks), mask)

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Bobbing":
        return Bobbing(self, rows, tuple(header["names"]))


class Bobbing(Node):
    """Every row is lifted by what a small network makes of the time, at most a meter."""

    settings: BobbingSettings

    def __init__(self, settings: BobbingSettings, rows: Rows, names: tuple[str, ...], mask: Mask | None = None) -> None:
        super().__init__(settings, rows, mask)
        self.names = names
        self.lift = nn.Sequential(nn.Linear(1, 4), nn.Tanh(), nn.Linear(4, 1))

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        local = self.stored(view)
        height = torch.tanh(self.lift(torch.tensor([view.time], device=local.means.device)))
        return replace(local, means=local.means + torch.cat((torch.zeros_like(height).expand(2), height)))

    def own_regularizers(
        self, raw: RawGaussians, drawn: Bool[Tensor, " n"], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        return {"stillness": self.settings.stillness * self.lift[2].get_parameter("weight").square().sum()}

    def instances(self) -> Instances:
        return Instances(self.names, self.rows.instances, torch.ones(len(self.names), 3))

    def header(self) -> dict[str, Any]:
        return {"names": list(self.names)}
