"""Seeds of the background."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes.background import Background
from sparsestreet.scene.seeds.boxes import moving_tracks, outside_boxes
from sparsestreet.scene.seeds.points import Points, far_positions, near_positions, random_points
from sparsestreet.scene.seeds.rows import MINIMUM_SCALE, neighbor_scales, seed_rows
from sparsestreet.types import Frame

LARGEST_RANDOM_RATIO = 0.02
"""Of a random seed's distance from the nearest camera. Their neighbors are meters away, so without a limit (here 1.1
degrees) they start as a fog that hides the lidar points and makes every early step slow."""


@dataclass(frozen=True)
class BackgroundSettings:
    """Lidar points outside moving boxes, random points around the drive and far away."""

    lidar_points: int = 100_000
    near_points: int = 20_000
    far_points: int = 20_000
    sh_degree: int = 3
    mask: StaticMask | None = None
    initial_opacity: float = 0.1
    min_path_length: float = 1.0
    """Meters; objects that travel farther leave no points in the background."""
    moving_classes: Sequence[str] | None = None
    """Classes that may move; None: all."""
    box_enlargement: float = 1.1
    """Of a moving object's box, for points that lie just outside an imprecise one."""

    def build(
        self, log: DrivingLog, train_frames: Sequence[Frame], held_out: frozenset[int], generator: torch.Generator
    ) -> Background:
        """Make the node from what training may see.

        Raises ValueError if there is not a single point to start from.
        """
        center = torch.as_tensor(log.center, dtype=torch.float32)
        lidar = self._lidar(log, held_out).sampled(self.lidar_points, generator)
        near = random_points(near_positions, self.near_points, center, log.radius, train_frames, generator)
        far = random_points(far_positions, self.far_points, center, log.radius, train_frames, generator)
        points = Points.concatenate([lidar, near, far])
        if len(points) == 0:
            raise ValueError(
                f"the background of {log.name!r} has no seeds: no colored lidar point of a training sweep, and no "
                f"random point (near_points={self.near_points}, far_points={self.far_points}) is seen by one of "
                f"{len(train_frames)} training views; raise near_points, or check the poses of the cameras"
            )
        scales = neighbor_scales(points.positions)
        limits = _largest_scales(points.positions[len(lidar) :], train_frames)
        scales[len(lidar) :] = torch.minimum(scales[len(lidar) :], limits)
        rows = seed_rows(
            points.positions,
            points.colors,
            scales,
            sh_degree=self.sh_degree,
            initial_opacity=self.initial_opacity,
            mask=self.mask,
            generator=generator,
        )
        return Background(rows, self.mask)

    def _lidar(self, log: DrivingLog, held_out: frozenset[int]) -> Points:
        """Colored returns of the training sweeps that lie in no moving box of their instant."""
        moving = moving_tracks(log.tracks, self.min_path_length, self.moving_classes)
        parts = []
        for sweep in log.sweeps:
            if sweep.index not in held_out:
                outside = outside_boxes(moving, sweep.index, sweep.points, self.box_enlargement)
                parts.append(Points(sweep.points, sweep.colors).where(sweep.colored & outside))
        return Points.concatenate(parts)


def _largest_scales(positions: Float[Tensor, "n 3"], frames: Sequence[Frame]) -> Float[Tensor, " n"]:
    """Meters, by the distance from the nearest camera."""
    cameras = torch.stack([frame.camera.position for frame in frames]).double().numpy()
    distances, _ = cKDTree(cameras).query(positions.double().numpy())
    return (LARGEST_RANDOM_RATIO * torch.from_numpy(distances).float()).clamp(min=MINIMUM_SCALE)
