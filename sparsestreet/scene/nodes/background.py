"""Everything that does not move: where it starts, and what it answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.initialize.boxes import outside_boxes
from sparsestreet.scene.initialize.gaussians import MINIMUM_SCALE, neighbor_scales
from sparsestreet.scene.initialize.points import Points, far_positions, near_positions, random_points
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import Gaussians, View

LARGEST_RANDOM_RATIO = 0.02
"""Of a random point's distance from the nearest camera. Their neighbors are meters away, so without a limit (here 1.1
degrees) they start as a fog that hides the lidar points and makes every early step slow."""


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(NodeSettings):
    """Starts from lidar points outside moving boxes, random points around the drive and far away."""

    num_lidar: int
    num_near: int
    num_far: int
    box_enlargement: float = 1.1
    """Of a moving object's box, for points that lie just outside an imprecise one."""

    def build(self, data: TrainingData, generator: torch.Generator) -> "Background":
        """Raises ValueError if there is not a single point to start from."""
        log = data.log
        center = torch.as_tensor(log.center, dtype=torch.float32)
        lidar = self._lidar(data).sampled(self.num_lidar, generator)
        near = random_points(near_positions, self.num_near, center, log.radius, data.frames, generator)
        far = random_points(far_positions, self.num_far, center, log.radius, data.frames, generator)
        points = Points.concatenate([lidar, near, far])
        if len(points) == 0:
            raise ValueError(
                f"the background of {log.name!r} has nothing to start from: no colored lidar point of a training "
                f"sweep, and no random point (num_near={self.num_near}, num_far={self.num_far}) is seen by one of "
                f"{len(data.frames)} training views; raise num_near, or check the poses of the cameras"
            )
        scales = neighbor_scales(points.positions)
        limits = _largest_scales(points.positions[len(lidar) :], data.views)
        scales[len(lidar) :] = torch.minimum(scales[len(lidar) :], limits)
        rows, mask = self.start(data, points, scales, generator)
        return Background(self, rows, mask)

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Background":
        return Background(self, rows)

    def _lidar(self, data: TrainingData) -> Points:
        """Colored returns of the training sweeps that lie in no moving box of their instant."""
        parts = []
        for sweep in data.sweeps:
            outside = outside_boxes(data.moving, sweep.index, sweep.points, self.box_enlargement)
            parts.append(Points(sweep.points, sweep.colors).where(sweep.colored & outside))
        return Points.concatenate(parts)


class Background(Node):
    """Static Gaussians; their rows are in the world frame already."""

    def gaussians_at(self, view: View, state: SceneState) -> Gaussians:
        """The same Gaussians in every view, activated, with the mask applied."""
        return self.activated(view, state)


def _largest_scales(positions: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, " n"]:
    """Meters, by the distance from the nearest camera."""
    cameras = torch.stack([view.camera.position for view in views]).double().numpy()
    distances, _ = cKDTree(cameras).query(positions.double().numpy())
    return (LARGEST_RANDOM_RATIO * torch.from_numpy(distances).float()).clamp(min=MINIMUM_SCALE)
