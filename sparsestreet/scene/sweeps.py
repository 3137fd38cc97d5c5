"""Sweeps of a lidar in a scene: the rays of a model, fired one after the other while sensor and objects move."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.lidar_models import LidarModel
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.intensities import intensities_of
from sparsestreet.scene.lidar import PIXEL, PIXELS, Rays, render_ranges
from sparsestreet.scene.state import DEFAULT_OPTIONS, RenderOptions


@dataclass(frozen=True)
class Returns:
    """What comes back of a turn, in the order in which it was fired; on the host."""

    points: Float64[Tensor, "n 3"]
    """Meters, in the frame of the lidar at the instant of the sweep."""
    intensities: Float64[Tensor, " n"]
    """In [0, 1]; 0 where the scene has learned none."""
    seconds: Float64[Tensor, " n"]
    """When each was fired, since that instant."""

    def __len__(self) -> int:
        return len(self.points)


@torch.no_grad()
def render_sweep(
    scene: SceneGraph,
    model: LidarModel,
    world_from_lidar: Callable[[float], Float64[Tensor, "4 4"]],
    time: float,
    options: RenderOptions = DEFAULT_OPTIONS,
    *,
    duration: float,
    span: tuple[float, float] | None = None,
) -> Returns:
    """Draw a turn of a lidar. A ray returns where more than half of its light is stopped within the lidar's reach.

    Args:
        scene: what is looked at.
        model: the lidar.
        world_from_lidar: its pose, by the seconds since the instant of the sweep.
        time: normalized time of that instant.
        options: how the scene is rendered.
        duration: seconds of the log from time 0 to 1. Beyond these, objects stand still.
        span: seconds since the instant at which the turn begins and ends; None: half a turn before and after it.

    Raises ValueError as ``render_ranges``.
    """
    start, end = (-model.seconds / 2, model.seconds / 2) if span is None else span
    seconds = start + (end - start) * model.shares()
    directions = model.directions()
    rays = Rays(directions.float(), world_from_lidar, (PIXELS * PIXEL, PIXELS * PIXEL), seconds.float())
    met = render_ranges(scene, rays, time, options, duration=duration)
    kept = met.ranges <= model.reach
    points = torch.zeros(int(kept.sum()), 3, dtype=torch.float64)
    lidar_from_world = inverse(world_from_lidar(0.0))
    own, drawn_at = directions[kept] * met.ranges[kept].double()[:, None], met.seconds[kept]
    # A range belongs to the pose of its view, and so does the point.
    for moment in drawn_at.unique().tolist():
        rows = drawn_at == moment
        points[rows] = transform_points(lidar_from_world @ world_from_lidar(moment), own[rows])
    table = intensities_of(scene)
    intensities = torch.zeros(len(points)) if table is None else table.cpu()[met.rows[kept]]
    return Returns(points, intensities.double(), seconds[kept])
