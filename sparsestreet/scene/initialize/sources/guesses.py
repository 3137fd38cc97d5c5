"""Random points where neither lidar nor images give points."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.data.lidar import visible_pixels
from sparsestreet.geometry.cameras import project
from sparsestreet.scene.initialize.coverage import Coverage
from sparsestreet.scene.initialize.gaussians import MINIMUM_SCALE
from sparsestreet.scene.initialize.points import Points
from sparsestreet.scene.initialize.sources.source import PointSource, Seeds, check_positive
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.types import Frame, View

CANDIDATES_PER_POINT = 3
"""Number of random positions drawn at once for each wanted point, since most lie in no view (DriveStudio)."""

VIEWS_PER_ROUND = 24
"""Number of views that each draw is tested against, chosen anew; neighboring views see nearly the same space."""

ROUNDS = 10
"""Largest number of draws. A scene whose cameras see little of the space may then have fewer points."""


@dataclass(frozen=True, kw_only=True)
class Guesses(PointSource):
    """Random positions that some training view sees, and not as sky.

    Raises ValueError for impossible settings.
    """

    part: float
    """Fraction of the share of pixels that nothing covers."""
    largest_scale: float | None = 0.02
    """Largest scale as a fraction of a point's distance from the nearest camera, here 1.1 degrees; None: no limit.
    Neighbors of guesses are meters away. Without a limit, guesses start as a fog that hides other points and slows
    every early step."""
    blind: bool = False
    """Whether no image is looked at, as in DriveStudio: three times as many positions as asked for are drawn once. All
    that lie in the image of some training view are kept, also in the sky, in random colors."""

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
        if self.blind:
            candidates = self.positions(CANDIDATES_PER_POINT * count, center, data.log.radius, generator)
            found = in_some_view(candidates, data.views)
            points = Points(found, torch.rand(found.shape, generator=generator))
        else:
            points = random_points(self.positions, count, center, data.log.radius, data.frames, generator)
        if self.largest_scale is None:
            return self.seeds(points)
        limit = self.largest_scale * _camera_distances(points.positions, data.views)
        return self.seeds(points, largest=limit.clamp(min=MINIMUM_SCALE))

    @abstractmethod
    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Returns ``count`` random positions in a scene with this center and radius, meters."""


def random_points(
    draw: Callable[[int, Tensor, float, torch.Generator], Tensor],
    count: int,
    center: Float[Tensor, "3"],
    radius: float,
    frames: Sequence[Frame],
    generator: torch.Generator,
) -> Points:
    """Returns ``count`` points of the distribution ``draw`` that the frames see; fewer if they see too little of it."""
    found = Points.concatenate([])
    for _ in range(ROUNDS):
        if len(found) >= count:
            break
        candidates = draw(CANDIDATES_PER_POINT * count, center, radius, generator)
        views = torch.randperm(len(frames), generator=generator)[:VIEWS_PER_ROUND].tolist()
        found = Points.concatenate([found, seen_points(candidates, (frames[view] for view in views))])
    return found.sampled(count, generator)


def seen_points(positions: Float[Tensor, "n 3"], frames: Iterable[Frame]) -> Points:
    """Returns the positions that the first view looking at them does not show as sky, with their color in that view.

    A ray that ends in the sky meets nothing, so a Gaussian on it could only learn to vanish. Without sky masks every
    position inside some view is kept. A view does not look at what the recording car hides.
    """
    kept, undecided = [], positions
    for frame in frames:
        rows, pixels, _ = visible_pixels(frame.camera, undecided, frame.ego)
        seen = Points(undecided[rows], frame.image.reshape(-1, 3)[pixels].float() / 255)
        kept.append(seen if frame.sky is None else seen.where(~frame.sky.flatten()[pixels]))
        left = torch.ones(len(undecided), dtype=torch.bool)
        left[rows] = False
        undecided = undecided[left]
    return Points.concatenate(kept)


def in_some_view(positions: Float[Tensor, "n 3"], views: Iterable[View]) -> Float[Tensor, "k 3"]:
    """Returns the positions that lie inside the image of at least one view, in their order."""
    unseen = torch.arange(len(positions))
    for view in views:
        _, _, inside = project(view.camera, positions[unseen])
        unseen = unseen[~inside]
    seen = torch.ones(len(positions), dtype=torch.bool)
    seen[unseen] = False
    return positions[seen]


def directions(count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Returns unit vectors, uniform on the sphere.

    >>> directions(3, torch.Generator().manual_seed(0)).norm(dim=1).round(decimals=3).tolist()
    [1.0, 1.0, 1.0]
    """
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def _camera_distances(positions: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, " n"]:
    """Returns the distance to the nearest camera, meters."""
    cameras = torch.stack([view.camera.position for view in views]).double().numpy()
    distances, _ = KDTree(cameras).query(positions.double().numpy())
    return torch.from_numpy(distances).float()
