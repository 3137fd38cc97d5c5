"""Seeds of rigid objects."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.scene.masks import StaticMask
from sparsestreet.scene.nodes.rigid import Rigid
from sparsestreet.scene.nodes.trajectory import Trajectories
from sparsestreet.scene.seeds.boxes import inside_box, moving_tracks, points_in_box_frame
from sparsestreet.scene.seeds.points import Points
from sparsestreet.scene.seeds.rows import neighbor_scales, seed_rows
from sparsestreet.types import Frame, Sweep, Track


@dataclass(frozen=True)
class RigidSettings:
    """Lidar points of all training instants pooled in the frame of each object's box."""

    classes: Sequence[str]
    min_path_length: float = 1.0
    """Meters; an object that travels no farther is left to the background."""
    points_per_instance: int = 5000
    box_points: int = 1000
    """An instance with fewer lidar points than this is filled up with random points on the faces of its box."""
    sh_degree: int = 3
    mask: StaticMask | None = None
    initial_opacity: float = 0.1
    max_gap: int = 2
    """Frames; an object is present within its span up to this far from a training annotation."""

    def build(
        self, log: DrivingLog, train_frames: Sequence[Frame], held_out: frozenset[int], generator: torch.Generator
    ) -> Rigid | None:
        """Make the node from what training may see; None where no object of the classes qualifies.

        Boxes of frames without training image (held out, or outside the training range) are not used.
        """
        tracks = [
            track
            for track in moving_tracks(log.tracks, self.min_path_length, self.classes)
            if any(int(frame) not in held_out for frame in track.frames)
        ]
        if not tracks:
            return None
        sweeps = [sweep for sweep in log.sweeps if sweep.index not in held_out]
        instances = [self._instance_points(track, sweeps, generator) for track in tracks]
        points = Points.concatenate(instances)
        counts = torch.tensor([len(instance) for instance in instances])
        rows = seed_rows(
            points.positions,
            points.colors,
            # Per instance: in their own frames all objects lie on top of each other.
            torch.cat([neighbor_scales(instance.positions) for instance in instances]),
            sh_degree=self.sh_degree,
            initial_opacity=self.initial_opacity,
            mask=self.mask,
            generator=generator,
            buffers={"instances": torch.repeat_interleave(torch.arange(len(tracks)), counts)},
        )
        sizes = torch.stack([track.size.float() for track in tracks])
        gap = self.max_gap / max(log.num_frames - 1, 1)
        return Rigid(rows, Trajectories.from_tracks(tracks, held_out, log.num_frames), sizes, self.mask, gap)

    def _instance_points(self, track: Track, sweeps: Sequence[Sweep], generator: torch.Generator) -> Points:
        """One object's colored points in its box frame, filled up where lidar left too few."""
        lidar = _lidar_in_box(track, sweeps).sampled(self.points_per_instance, generator)
        missing = min(self.box_points, self.points_per_instance) - len(lidar)
        if missing <= 0:
            return lidar
        color = lidar.colors.mean(0) if len(lidar) else torch.full((3,), 0.5)
        surface = box_surface_points(missing, track.size.float(), generator)
        return Points.concatenate([lidar, Points(surface, color.expand(missing, 3))])


def box_surface_points(count: int, size: Float[Tensor, "3"], generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Random points on the faces of a box about the origin, spread evenly over its area."""
    length, width, height = size.tolist()
    areas = torch.tensor([width * height, length * height, length * width])
    axis = torch.multinomial(areas, count, replacement=True, generator=generator)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * size
    side = torch.where(torch.rand(count, generator=generator) < 0.5, -0.5, 0.5)
    points[torch.arange(count), axis] = side * size[axis]
    return points


def _lidar_in_box(track: Track, sweeps: Sequence[Sweep]) -> Points:
    """Colored returns inside the object's box at their own instant, in the box frame."""
    parts = []
    for sweep in sweeps:
        in_box_frame = points_in_box_frame(track, sweep.index, sweep.points)
        if in_box_frame is not None:
            inside = inside_box(in_box_frame, track.size) & sweep.colored
            parts.append(Points(in_box_frame, sweep.colors).where(inside))
    return Points.concatenate(parts)
