"""The node of everything that does not move."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.initialize.gaussians import Points, lie_flat, neighbor_scales, outside_swept_boxes
from sparsestreet.scene.initialize.sources import FarPoints, ImagePoints, LidarPoints, NearPoints, PointSource, Seeds
from sparsestreet.scene.initialize.training_data import Coverage, TrainingData, coverage
from sparsestreet.scene.learning_rate import Rates, usual_background_rates
from sparsestreet.scene.masks import Mask
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.scene.state import SceneState
from sparsestreet.types import View

_log = logging.getLogger(__name__)

_EXTREMES = (Coverage(1.0, 0.0), Coverage(0.0, 1.0), Coverage(0.0, 0.0))
"""Everything is near lidar, near points from images, or near neither. Linear shares are largest at one of these."""


def usual_sources() -> dict[str, PointSource]:
    """Return the sources of conf/options/source.yaml: lidar, images, and guesses where neither sees anything.

    >>> list(usual_sources())
    ['lidar', 'images', 'near', 'far']
    """
    return {
        "lidar": LidarPoints(),
        "images": ImagePoints(),
        "near": NearPoints(part=0.333),
        "far": FarPoints(part=0.667),
    }


@dataclass(frozen=True, kw_only=True)
class BackgroundSettings(NodeSettings):
    """Settings of a background that starts from the points of its sources.

    Raises ValueError for limits that contradict each other, and for sources that ask for more than all points.
    """

    min_gaussians: int = 4000
    max_gaussians: int | None = 130_000
    limit_rises: bool = True
    num_points: int = 40_000
    """Largest number of points of all sources together, but for those with a ``number``. The coverage of the training
    images sets each one's share."""
    sources: Mapping[str, PointSource] = field(default_factory=usual_sources)
    """Name -> source of points. Each draws from its own stream, so changing one leaves the points of the others."""
    learning_rates: Rates = field(default_factory=usual_background_rates)
    clear_swept_boxes: bool = False
    """Whether a point of any source goes that lies in the box of a moving object at any training frame (DriveStudio):
    what a car drives over starts empty."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_points < 0:
            raise ValueError(f"num_points must be >= 0, got {self.num_points}")
        for name, source in self.sources.items():
            if not isinstance(source, PointSource):
                raise ValueError(
                    f"a background's sources give points, got {name}={source}: leave one out with "
                    f"~node.background.sources.{name}"
                )
        sharing = [source for source in self.sources.values() if source.number is None]
        most = max(sum(source.share(seen) for source in sharing) for seen in _EXTREMES)
        if most > 1 + 1e-6:
            raise ValueError(
                f"the shares of the sources {', '.join(self.sources)} may add up to 1 at most, got {most:g}: "
                "lower the part of one"
            )

    def build(self, data: TrainingData, generator: torch.Generator) -> "Background":
        """Raise ValueError if there is not a single point to start from."""
        return Background(self, *self.start_from(self.seeds(data, generator), data, generator))

    def seeds(self, data: TrainingData, generator: torch.Generator) -> Seeds:
        """Return the points of the sources. Raises ValueError if there is not a single point."""
        asked = self.sources, self.num_points, self.clear_swept_boxes
        said = asked, generator.initial_seed(), data.moving, data.image_points
        return data.log.kept.get("seeds", said, lambda: self._drawn(data, generator), Seeds, Points)

    def _drawn(self, data: TrainingData, generator: torch.Generator) -> Seeds:
        shared = any(source.number is None for source in self.sources.values())
        seen = coverage(data) if shared else Coverage(0.0, 0.0)  # of which nobody asks for a share
        drawn = {
            name: source.draw(self._asked(source, seen), data, named_generator(generator.initial_seed(), name))
            for name, source in self.sources.items()
        }
        counts = ", ".join(f"{name}: {len(seeds)}" for name, seeds in drawn.items())
        _log.info("%spoints from %s", _covered(seen) if shared else "", counts)
        seeds = Seeds.concatenate(list(drawn.values()))
        if self.clear_swept_boxes:
            kept = outside_swept_boxes(data.moving, seeds.points.positions, data.held_out)
            _log.info("%d of them lie where a moving object passes, and go", int((~kept).sum()))
            seeds = seeds.where(kept)
        if len(seeds) == 0:
            raise ValueError(
                f"the background of {data.log.name!r} has nothing to start from: none of "
                f"num_points={self.num_points} came from {', '.join(drawn) or 'its sources, which are none'}; raise "
                f"num_points, add a source, or check the poses of the {len(data.frames)} training views"
            )
        return seeds

    def _asked(self, source: PointSource, seen: Coverage) -> int:
        """Return how many points a source is asked for: its own number, or its share by what the images show."""
        return round(self.num_points * source.share(seen)) if source.number is None else source.number

    def start_from(
        self,
        seeds: Seeds,
        data: TrainingData,
        generator: torch.Generator,
        columns: Mapping[str, Tensor] | None = None,
    ) -> tuple[Rows, Mask | None]:
        """Call ``start`` with the scales, meters, that seeds and their neighbors allow; what is on a surface lies in
        it."""
        scales = neighbor_scales(seeds.points.positions).clamp(seeds.smallest, seeds.largest)
        rows, mask = self.start(data, seeds.points, scales, seeds.opacities, generator, columns=columns)
        lie_flat(rows, seeds.normals)
        return rows, mask

    def restore(self, rows: Rows, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> "Background":
        return Background(self, rows)


def _covered(seen: Coverage) -> str:
    return (
        f"the lidar covers {100 * seen.lidar:.0f} % of the pixels that are not sky, images {100 * seen.images:.0f} % "
        "more; "
    )


class Background(Node):
    """Static Gaussians, whose rows are in the world frame."""

    def raw_at(self, view: View, state: SceneState) -> RawGaussians:
        """Return the same Gaussians for every view, except for the mask."""
        return self.stored(view)
