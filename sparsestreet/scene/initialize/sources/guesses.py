"""Random points where nothing else says what is there."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.geometry.cameras import project
from sparsestreet.scene.initialize.coverage import Coverage
from sparsestreet.scene.initialize.gaussians import MINIMUM_SCALE
from sparsestreet.scene.initialize.points import Points
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds, check_positive
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.types import Frame, View

CANDIDATES_PER_POINT = 3
"""Random positions drawn at once for each one wanted, since most lie in no view (DriveStudio)."""

VIEWS_PER_ROUND = 24
"""Views that each draw is tested against, chosen anew: neighboring views see nearly the same space."""

ROUNDS = 10
"""Draws before a scene whose cameras see a small part of the space makes do with fewer points."""


@dataclass(frozen=True, kw_only=True)
class Guesses(PointSource):
    """Positions drawn at random, of which those count that some training view sees, and not as sky.

    Raises ValueError for settings that cannot be.
    """

    part: float
    """Of the share of the pixels that nothing covers."""
    largest_scale: float = 0.02
    """Of a point's distance from the nearest camera. Their neighbors are meters away, so without a limit (here 1.1
    degrees) they start as a fog that hides the other points and makes every early step slow."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.part <= 1:
            raise ValueError(
                f"part must lie in [0, 1], got {self.part}: it is a fraction of what lidar and images leave"
            )
        check_positive(largest_scale=self.largest_scale)

    def share(self, coverage: Coverage) -> float:
        return self.part * coverage.nothing

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        center = torch.as_tensor(data.log.center, dtype=torch.float32)
        points = random_points(self.positions, count, center, data.log.radius, data.frames, generator)
        limit = self.largest_scale * _camera_distances(points.positions, data.views)
        return self.seeds(points, largest=limit.clamp(min=MINIMUM_SCALE))

    @abstractmethod
    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """So many random positions in a scene of a center and a radius, meters."""


def random_points(
    draw: Callable[[int, Tensor, float, torch.Generator], Tensor],
    count: int,
    center: Float[Tensor, "3"],
    radius: float,
    frames: Sequence[Frame],
    generator: torch.Generator,
) -> Points:
    """``count`` points of the distribution ``draw`` that the frames see; fewer if they see too little of it."""
    found = Points.concatenate([])
    for _ in range(ROUNDS):
        if len(found) >= count:
            break
        candidates = draw(CANDIDATES_PER_POINT * count, center, radius, generator)
        views = torch.randperm(len(frames), generator=generator)[:VIEWS_PER_ROUND].tolist()
        found = Points.concatenate([found, seen_points(candidates, (frames[view] for view in views))])
    return found.sampled(count, generator)


def seen_points(positions: Float[Tensor, "n 3"], frames: Iterable[Frame]) -> Points:
    """Those positions that the first view looking at them does not show as sky, with the color they have there.

    A ray that ends in the sky meets nothing, so a Gaussian on it could only learn to vanish. Without sky masks every
    position inside some view is kept.
    """
    kept, undecided = [], positions
    for frame in frames:
        pixels, _, inside = project(frame.camera, undecided)
        column, row = pixels[inside].long().unbind(1)
        seen = Points(undecided[inside], frame.image[row, column].float() / 255)
        kept.append(seen if frame.sky is None else seen.where(~frame.sky[row, column]))
        undecided = undecided[~inside]
    return Points.concatenate(kept)


def directions(count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Uniform on the sphere."""
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def _camera_distances(positions: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, " n"]:
    """Meters to the nearest camera."""
    cameras = torch.stack([view.camera.position for view in views]).double().numpy()
    distances, _ = KDTree(cameras).query(positions.double().numpy())
    return torch.from_numpy(distances).float()
