"""Where the background's first points come from: lidar, images, and guesses near and far."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.data.lidar import visible_pixels
from sparsestreet.geometry.boxes import without_frames
from sparsestreet.geometry.cameras import project
from sparsestreet.scene.initialize.gaussians import (
    MINIMUM_SCALE,
    Points,
    at_most,
    fit_planes,
    lidar_in_boxes,
    outside_boxes,
    thinned,
)
from sparsestreet.scene.initialize.training_data import Coverage, TrainingData, beyond_lidar
from sparsestreet.triangulation import TriangulatedPoints
from sparsestreet.types import Frame, Track, View


@dataclass(frozen=True)
class Seeds:
    """Points, and what their source knows about the Gaussians that start there."""

    points: Points
    smallest: Float[Tensor, " n"]
    """Limits of a Gaussian's scale, meters; between them the distance to its neighbors sets the scale."""
    largest: Float[Tensor, " n"]
    opacities: Float[Tensor, " n"]
    times: Float[Tensor, " n"]
    """Normalized time at which each point was measured; NaN if unknown."""
    normals: Float[Tensor, "n 3"]
    """Of the flat piece that a point lies in, unit length, z not negative; NaN if it lies in none, or unknown."""

    def __len__(self) -> int:
        return len(self.points)

    def where(self, mask: Bool[Tensor, " n"]) -> "Seeds":
        return Seeds(
            self.points.where(mask),
            self.smallest[mask],
            self.largest[mask],
            self.opacities[mask],
            self.times[mask],
            self.normals[mask],
        )

    @staticmethod
    def concatenate(parts: Sequence["Seeds"]) -> "Seeds":
        empty = torch.zeros(0)
        return Seeds(
            Points.concatenate([part.points for part in parts]),
            torch.cat([empty, *(part.smallest for part in parts)]),
            torch.cat([empty, *(part.largest for part in parts)]),
            torch.cat([empty, *(part.opacities for part in parts)]),
            torch.cat([empty, *(part.times for part in parts)]),
            torch.cat([torch.zeros(0, 3), *(part.normals for part in parts)]),
        )


@dataclass(frozen=True, kw_only=True)
class PointSource(ABC):
    """One source of initial points.

    Raises ValueError for impossible settings.
    """

    initial_opacity: float = 0.1
    number: int | None = None
    """How many points the source is asked for, whatever the images show; None: its share of the node's points."""

    def __post_init__(self) -> None:
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"initial_opacity must lie between 0 and 1, got {self.initial_opacity}: take 0.1")
        if self.number is not None and self.number < 0:
            raise ValueError(f"number must be >= 0, got {self.number}: 0 points, or null for a share of the node's")

    @abstractmethod
    def share(self, coverage: Coverage) -> float:
        """Return the fraction of the node's points that the source is asked for if it has no ``number``.

        The fractions of a node's sources add up to 1 at most; the rest of the points is left out.
        """

    @abstractmethod
    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        """Return ``count`` points, or all points if there are fewer."""

    def seeds(
        self,
        points: Points,
        smallest: Float[Tensor, " n"] | None = None,
        largest: Float[Tensor, " n"] | None = None,
        times: Float[Tensor, " n"] | None = None,
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> Seeds:
        """Return seeds with the source's opacity; limits of the scale are meters (None: no limit on that side),
        ``times`` are normalized times of measurement, ``normals`` those of surfaces (None: unknown)."""
        count = len(points)
        return Seeds(
            points,
            torch.full((count,), MINIMUM_SCALE) if smallest is None else smallest,
            torch.full((count,), torch.inf) if largest is None else largest,
            torch.full((count,), self.initial_opacity),
            torch.full((count,), torch.nan) if times is None else times,
            torch.full((count, 3), torch.nan) if normals is None else normals,
        )


def check_positive(**values: float | None) -> None:
    """Raise ValueError for a setting that is not above 0; None passes."""
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be larger than 0, got {value}")


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
        limit = self.largest_scale * _nearest_camera(points.positions, data.views)[0]
        return self.seeds(points, largest=limit.clamp(min=MINIMUM_SCALE))

    @abstractmethod
    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Return ``count`` random positions in a scene with this center and radius, meters."""


def random_points(
    draw: Callable[[int, Tensor, float, torch.Generator], Tensor],
    count: int,
    center: Float[Tensor, "3"],
    radius: float,
    frames: Sequence[Frame],
    generator: torch.Generator,
) -> Points:
    """Return ``count`` points of the distribution ``draw`` that the frames see; fewer if they see too little of it."""
    found = Points.concatenate([])
    for _ in range(ROUNDS):
        if len(found) >= count:
            break
        candidates = draw(CANDIDATES_PER_POINT * count, center, radius, generator)
        views = torch.randperm(len(frames), generator=generator)[:VIEWS_PER_ROUND].tolist()
        found = Points.concatenate([found, seen_points(candidates, (frames[view] for view in views))])
    return found.sampled(count, generator)


def seen_points(positions: Float[Tensor, "n 3"], frames: Iterable[Frame]) -> Points:
    """Return the positions that the first view looking at them does not show as sky, with their color in that view.

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
    """Return the positions that lie inside the image of at least one view, in their order."""
    unseen = torch.arange(len(positions))
    for view in views:
        _, _, inside = project(view.camera, positions[unseen])
        unseen = unseen[~inside]
    seen = torch.ones(len(positions), dtype=torch.bool)
    seen[unseen] = False
    return positions[seen]


def directions(count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Return unit vectors, uniform on the sphere.

    >>> directions(3, torch.Generator().manual_seed(0)).norm(dim=1).round(decimals=3).tolist()
    [1.0, 1.0, 1.0]
    """
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def _nearest_camera(
    positions: Float[Tensor, "n 3"], views: Sequence[View]
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Return the distance to the nearest camera, meters, and the number of its view."""
    cameras = torch.stack([view.camera.position for view in views]).double().numpy()
    distances, nearest = KDTree(cameras).query(positions.double().numpy())
    return torch.from_numpy(distances).float(), torch.from_numpy(nearest)


FARTHEST_RATIO = 0.02
"""Smallest u of far points, which are drawn at radius / u (DriveStudio): out to 50 times the scene's radius."""


@dataclass(frozen=True, kw_only=True)
class FarPoints(Guesses):
    """Random points outside the ball around the scene."""

    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Return points in uniform directions at distance radius / u; density falls with distance.

        u is uniform in [FARTHEST_RATIO, 1]. If ``blind``, it is uniform in [0, 1] and clamped, as in DriveStudio.
        """
        u = torch.rand(count, 1, generator=generator)
        u = u.clamp(min=FARTHEST_RATIO) if self.blind else FARTHEST_RATIO + (1 - FARTHEST_RATIO) * u
        return center + radius / u * directions(count, generator)


@dataclass(frozen=True, kw_only=True)
class ImagePoints(PointSource):
    """Points of static things: those that the run triangulates, and those of the log (``DrivingLog.sparse_points``).

    Raises ValueError for impossible settings.

    >>> ImagePoints().share(Coverage(lidar=0.5, images=0.25))
    0.25
    """

    initial_opacity: float = 0.5
    order: Literal["beyond_first", "beyond_only", "random"] = "beyond_first"
    """Points to take: those beyond the lidar before the others, those beyond it alone, or any."""
    voxel: float | None = None
    """Side of a cube, meters, from which one point is taken; None: all points."""
    smallest_pixels: float = 0.5
    """Limits of a Gaussian's scale, in pixels of the view nearest to the point."""
    largest_pixels: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(voxel=self.voxel, smallest_pixels=self.smallest_pixels)
        if self.largest_pixels < self.smallest_pixels:
            raise ValueError(
                f"largest_pixels must be at least smallest_pixels, got {self.largest_pixels} and "
                f"{self.smallest_pixels}: raise the first or lower the second"
            )

    def share(self, coverage: Coverage) -> float:
        return coverage.images

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        points, pixel = Points.concatenate([]), torch.zeros(0)
        if data.image_points is not None:
            found = data.image_points.static
            chosen = self._chosen(found, count, data, generator)
            points = _points_of(found).where(chosen)
            pixel = torch.from_numpy(found.pixel_sizes)[chosen]
        if data.log.sparse_points is not None:
            points, pixel = self._with_sparse(points, pixel, count, data, generator)
        return self.seeds(points, self.smallest_pixels * pixel, self.largest_pixels * pixel)

    def _with_sparse(
        self, points: Points, pixel: Float[Tensor, " n"], count: int, data: TrainingData, generator: torch.Generator
    ) -> tuple[Points, Float[Tensor, " k"]]:
        """Any ``count`` of the points, whose pixels' sizes are given, and those of the log."""
        assert data.log.sparse_points is not None
        sparse = data.log.sparse_points()
        rows = torch.arange(len(sparse)) if self.voxel is None else thinned(sparse.positions, self.voxel, generator)
        both = Points.concatenate([points, Points(sparse.positions, sparse.colors).where(rows)])
        sizes = torch.cat((pixel, pixel_sizes(sparse.positions[rows], data.views)))
        chosen = at_most(count, torch.arange(len(both)), generator)
        return both.where(chosen), sizes[chosen]

    def _chosen(
        self, found: TriangulatedPoints, count: int, data: TrainingData, generator: torch.Generator
    ) -> Int[Tensor, " k"]:
        if self.voxel is None:
            order = torch.randperm(len(found), generator=generator)
        else:
            order = thinned(torch.from_numpy(found.positions), self.voxel, generator)
        if self.order != "random":
            beyond = beyond_lidar(data, found)[order]
            rest = order[:0] if self.order == "beyond_only" else order[~beyond]
            order = torch.cat((order[beyond], rest))
        return order[:count]


def points_from_images(track: Track, data: TrainingData) -> Points:
    """Return the triangulated points inside the track's box, in its frame; none if the run makes none."""
    return Points.concatenate([] if data.image_points is None else [_points_of(data.image_points.in_boxes[track.name])])


def returns_in_boxes(tracks: Sequence[Track], data: TrainingData) -> list[Points]:
    """Return ``lidar_in_boxes`` of the training part of a log."""
    boxes = without_frames(tracks, data.held_out)
    return data.log.kept.get("boxes", boxes, lambda: lidar_in_boxes(boxes, data.sweeps), Points)


def _points_of(found: TriangulatedPoints) -> Points:
    return Points(torch.from_numpy(found.positions), torch.from_numpy(found.colors))


def pixel_sizes(positions: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, " n"]:
    """Return the sizes of a pixel at some points, meters, as the nearest camera sees them."""
    focal = torch.tensor([float(view.camera.intrinsics[0, 0]) for view in views])
    distances, nearest = _nearest_camera(positions, views)
    return distances / focal[nearest]


@dataclass(frozen=True, kw_only=True)
class LidarPoints(PointSource):
    """Colored returns of the training sweeps, outside all moving boxes of their instant if ``box_enlargement`` is set.

    Raises ValueError for impossible settings.
    """

    box_enlargement: float | None = 1.1
    """Factor on the sides of a moving object's box, because points may lie just outside an imprecise box; None: returns
    from moving objects are taken too."""
    voxel: float | None = None
    """Side of a cube, meters, from which one return is taken; None: all returns."""
    flat: bool = True
    """Whether a return on a road or wall starts in its plane, as a thin disk; False: as a ball, like all others."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(box_enlargement=self.box_enlargement, voxel=self.voxel)

    def share(self, coverage: Coverage) -> float:
        return coverage.lidar

    def draw(self, count: int, data: TrainingData, generator: torch.Generator) -> Seeds:
        parts, instants = [], [torch.zeros(0)]
        for sweep in data.sweeps:
            taken = sweep.colored
            if self.box_enlargement is not None:
                taken = taken & outside_boxes(data.moving, sweep, self.box_enlargement)
            parts.append(Points(sweep.points, sweep.colors).where(taken))
            instants.append(torch.full((len(parts[-1]),), sweep.time))
        points = Points.concatenate(parts)
        rows = torch.arange(len(points)) if self.voxel is None else thinned(points.positions, self.voxel, generator)
        chosen = at_most(count, rows, generator)
        taken, normals = points.where(chosen), None
        if self.flat:
            positions, normals = fit_planes(points.positions).onto(taken.positions)
            taken = Points(positions, taken.colors)
        return self.seeds(taken, times=torch.cat(instants)[chosen], normals=normals)


@dataclass(frozen=True, kw_only=True)
class NearPoints(Guesses):
    """Random points in the ball around the scene."""

    def positions(
        self, count: int, center: Float[Tensor, "3"], radius: float, generator: torch.Generator
    ) -> Float[Tensor, "n 3"]:
        """Return points that are uniform in the ball."""
        distance = radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
        return center + distance * directions(count, generator)
