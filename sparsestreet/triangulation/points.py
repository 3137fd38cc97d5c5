"""Triangulates points from views with known poses: each feature gathers its matches, whose rays must meet."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Shaped

from sparsestreet.data.images import WHITE
from sparsestreet.triangulation.matches import NEAREST, Features, guided_matches, image_pairs, in_image
from sparsestreet.triangulation.settings import ImagePointSettings
from sparsestreet.types import View

GAUSS_NEWTON_STEPS = 4
DAMPING = 1e-9
"""Added to the diagonal of the normal matrix, times its trace, because almost parallel rays leave it singular."""


@dataclass(frozen=True)
class Observations:
    """One row for each view of each point."""

    point: Int[np.ndarray, " o"]
    """Number of the point."""
    camera_from_frame: Float64[np.ndarray, "o 4 4"]
    rays: Float64[np.ndarray, "o 2"]
    """Normalized image points x/z, y/z."""
    focal: Float64[np.ndarray, " o"]
    """Pixels per unit of normalized image points."""

    def __len__(self) -> int:
        return len(self.rays)

    def where(self, rows: Bool[np.ndarray, " o"] | Int[np.ndarray, " k"]) -> "Observations":
        """The observations of a mask or of row numbers."""
        return Observations(self.point[rows], self.camera_from_frame[rows], self.rays[rows], self.focal[rows])

    def directions(self) -> tuple[Float64[np.ndarray, "o 3"], Float64[np.ndarray, "o 3"]]:
        """Camera centers and unit rays in the points' frame."""
        rotation, translation = self.camera_from_frame[:, :3, :3], self.camera_from_frame[:, :3, 3]
        centers = -np.einsum("oji,oj->oi", rotation, translation)
        local = np.concatenate((self.rays, np.ones((len(self), 1))), 1)
        rays = np.einsum("oji,oj->oi", rotation, local)
        return centers, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def meet(observations: Observations, count: int) -> Float64[np.ndarray, "n 3"]:
    """The position of least squared reprojection error of each point; the origin for a point without observations."""
    positions = _nearest_to_rays(observations, count)
    for _ in range(GAUSS_NEWTON_STEPS):
        residual, jacobian, _ = _reprojection(observations, positions)
        normal = summed(np.einsum("oki,okj->oij", jacobian, jacobian), observations.point, count)
        slope = summed(np.einsum("oki,ok->oi", jacobian, residual), observations.point, count)
        positions = positions - _solved(normal, slope)
    return positions


def reprojection_errors(
    observations: Observations, positions: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " o"], Float64[np.ndarray, " o"]]:
    """(error in pixels, depth in meters) of each observation; a point behind the camera has a negative depth."""
    residual, _, depth = _reprojection(observations, positions)
    return np.linalg.norm(residual, axis=1), depth


def relative_depth_error(
    observations: Observations, positions: Float64[np.ndarray, "n 3"], noise: float
) -> Float64[np.ndarray, " n"]:
    """Standard deviation of a point along its least certain direction over its distance from the nearest camera.

    The covariance is noise^2 (J^T J)^-1 with the Jacobian J of the reprojection; ``noise`` is the standard deviation of
    a feature in pixels. Unlike the angle between two rays, it counts many views of small parallax.
    """
    count = len(positions)
    _, jacobian, _ = _reprojection(observations, positions)
    normal = summed(np.einsum("oki,okj->oij", jacobian, jacobian), observations.point, count)
    weakest = np.linalg.eigvalsh(normal)[:, 0]
    centers, _ = observations.directions()
    distance = np.full(count, np.inf)
    np.minimum.at(distance, observations.point, np.linalg.norm(positions[observations.point] - centers, axis=1))
    return np.where(weakest > 0, noise / np.sqrt(np.maximum(weakest, 1e-300)) / distance, np.inf)


def _nearest_to_rays(observations: Observations, count: int) -> Float64[np.ndarray, "n 3"]:
    """Solves sum (I - d d^T) x = sum (I - d d^T) c over the rays c + s d."""
    centers, rays = observations.directions()
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = summed(across, observations.point, count)
    target = summed(np.einsum("oij,oj->oi", across, centers), observations.point, count)
    return _solved(normal, target)


def _reprojection(
    observations: Observations, positions: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "o 2"], Float64[np.ndarray, "o 2 3"], Float64[np.ndarray, " o"]]:
    """Residuals in pixels, their derivative with respect to the point, and depths."""
    rotation = observations.camera_from_frame[:, :3, :3]
    local = np.einsum("oij,oj->oi", rotation, positions[observations.point]) + observations.camera_from_frame[:, :3, 3]
    depth = local[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    projected = local[:, :2] / safe[:, None]
    residual = (projected - observations.rays) * observations.focal[:, None]
    jacobian = (rotation[:, :2] - projected[:, :, None] * rotation[:, 2:]) * (observations.focal / safe)[:, None, None]
    return residual, jacobian, depth


def summed(
    values: Shaped[np.ndarray, " o *s"], point: Int[np.ndarray, " o"], count: int
) -> Float64[np.ndarray, " n *s"]:
    """The sum over the observations of each point."""
    sums = np.zeros((count, *values.shape[1:]))
    for place in np.ndindex(*values.shape[1:]):
        sums[:, *place] = np.bincount(point, weights=values[:, *place], minlength=count)
    return sums


def _solved(matrix: Float64[np.ndarray, "n 3 3"], right: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    damping = DAMPING * np.trace(matrix, axis1=1, axis2=2) + 1e-12
    return np.linalg.solve(matrix + damping[:, None, None] * np.eye(3), right[:, :, None])[:, :, 0]


FEATURE_NOISE = 0.5
"""Standard deviation of a feature's position, pixels, for the uncertainty of a point."""

ROUNDS = 4
"""How often the worst observation of a point is dropped before the point itself is dropped."""


@dataclass(frozen=True)
class Sighting:
    """The features of one view that lie on one rigid thing."""

    view: View
    camera_from_frame: Float64[np.ndarray, "4 4"]
    """Pose of the camera in the frame in which the thing stands still."""
    features: Features
    rays: Float64[np.ndarray, "n 2"]
    """The features' normalized image points x/z, y/z, without lens distortion."""
    colors: Float32[np.ndarray, "n 3"]
    """RGB in [0, 1] at the features."""

    @property
    def focal(self) -> float:
        """Pixels per unit of normalized image points."""
        return float(self.view.camera.intrinsics[0, 0])

    def where(self, mask: Bool[np.ndarray, " n"]) -> "Sighting":
        return replace(self, features=self.features.where(mask), rays=self.rays[mask], colors=self.colors[mask])


@dataclass(frozen=True)
class TriangulatedPoints:
    """Points, and the pixels that show them; an observation is one view of one point."""

    positions: Float32[np.ndarray, "n 3"]
    """Meters."""
    colors: Float32[np.ndarray, "n 3"]
    """Mean RGB over the views, in [0, 1]."""
    pixel_sizes: Float32[np.ndarray, " n"]
    """Size of a pixel at the point in the nearest view, meters."""
    observed: Int[np.ndarray, " o"]
    """Point of each observation."""
    views: Int[np.ndarray, " o"]
    """View of each observation: its place in the list that was triangulated."""
    pixels: Float32[np.ndarray, "o 2"]
    """Pixel of each observation."""

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def concatenate(parts: "Sequence[TriangulatedPoints]") -> "TriangulatedPoints":
        """Return the points of all parts in order."""
        starts = np.cumsum([0, *map(len, parts)])[: len(parts)]
        joined = {
            entry.name: np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(parts[0])
        }
        observed = [part.observed + start for part, start in zip(parts, starts, strict=True)]
        return TriangulatedPoints(**(joined | {"observed": np.concatenate(observed)}))


def triangulate(
    sightings: Sequence[Sighting],
    settings: ImagePointSettings,
    progress: Callable[[int, int], None] | None = None,
) -> TriangulatedPoints:
    """Return the points on which the views agree; none if the cameras stand still.

    ``progress`` is called with the number of compared pairs of images, and of all pairs.
    """
    pairs = image_pairs([sighting.view for sighting in sightings], _poses(sightings))
    counts = np.array([len(sighting.features) for sighting in sightings], np.int64)
    view_of = np.repeat(np.arange(len(sightings)), counts)
    matches = _all_matches(sightings, pairs, np.cumsum(counts) - counts, settings, progress)
    centers, features, points = _stars(matches, len(view_of), settings.min_views)
    observations = _observations(sightings, view_of, features, points)
    agreed, positions = _agreed(observations, len(centers), settings)
    features, observations = features[agreed], observations.where(agreed)
    seen = np.bincount(observations.point, minlength=len(centers))
    with_center = np.zeros(len(centers), bool)
    with_center[observations.point[features == centers[observations.point]]] = True
    good = with_center & (relative_depth_error(observations, positions, FEATURE_NOISE) < settings.max_depth_error)
    good &= seen - 1 >= settings.min_support * _lookers(positions, view_of[centers], pairs, sightings)
    good &= ~_twins(centers, features, observations.point, seen, good)
    return _gathered(sightings, view_of, features, observations, positions, good)


def _poses(sightings: Sequence[Sighting]) -> Float64[np.ndarray, "v 4 4"]:
    return np.array([sighting.camera_from_frame for sighting in sightings]).reshape(-1, 4, 4)


def _all_matches(
    sightings: Sequence[Sighting],
    pairs: Sequence[tuple[int, int]],
    starts: Int[np.ndarray, " v"],
    settings: ImagePointSettings,
    progress: Callable[[int, int], None] | None,
) -> Int[np.ndarray, "k 2"]:
    """Matches of all pairs, features numbered over all views. Threads work here, because NumPy releases the lock."""

    def compare(pair: tuple[int, int]) -> Int[np.ndarray, "k 2"]:
        first, second = (sightings[index] for index in pair)
        found = guided_matches(
            first.features,
            second.features,
            first.rays,
            second.rays,
            second.camera_from_frame @ np.linalg.inv(first.camera_from_frame),
            tolerance=settings.epipolar_tolerance / second.focal,
            ratio=settings.ratio,
        )
        return found + starts[list(pair)]

    parts: list[Int[np.ndarray, "k 2"]] = [np.zeros((0, 2), np.int64)]
    with ThreadPoolExecutor(settings.workers) as executor:
        for done, part in enumerate(executor.map(compare, pairs), start=1):
            parts.append(part)
            if progress is not None:
                progress(done, len(pairs))
    return np.concatenate(parts)


def _stars(
    matches: Int[np.ndarray, "k 2"], count: int, min_views: int
) -> tuple[Int[np.ndarray, " s"], Int[np.ndarray, " o"], Int[np.ndarray, " o"]]:
    """(center, feature, point): each feature with its own matches, itself first, is one candidate point.

    Matches of matches are not joined, because one wrong match would join two points.
    """
    both = np.concatenate((matches, matches[:, ::-1]))
    centers = np.flatnonzero(np.bincount(both[:, 0], minlength=count) >= min_views - 1)
    number = np.full(count, -1)
    number[centers] = np.arange(len(centers))
    both = both[number[both[:, 0]] >= 0]
    features = np.concatenate((centers, both[:, 1]))
    return centers, features, np.concatenate((np.arange(len(centers)), number[both[:, 0]]))


def _observations(
    sightings: Sequence[Sighting],
    view_of: Int[np.ndarray, " n"],
    features: Int[np.ndarray, " o"],
    points: Int[np.ndarray, " o"],
) -> Observations:
    views = view_of[features]
    focal = np.array([sighting.focal for sighting in sightings])
    rays = np.concatenate([np.zeros((0, 2)), *(sighting.rays for sighting in sightings)])
    return Observations(points, _poses(sightings)[views], rays[features], focal[views])


def _agreed(
    observations: Observations, count: int, settings: ImagePointSettings
) -> tuple[Bool[np.ndarray, " o"], Float64[np.ndarray, "s 3"]]:
    """Drops the worst observation of each point while it is too far off; returns (observations left, positions).

    Points with a bad observation after all rounds, or with too few views, keep none.
    """
    left, positions = np.zeros(len(observations), bool), np.zeros((count, 3))
    open_rows = np.arange(len(observations))
    for _ in range(ROUNDS + 1):
        points, number = np.unique(observations.point[open_rows], return_inverse=True)
        now = replace(observations.where(open_rows), point=number)
        met = meet(now, len(points))
        error, depth = reprojection_errors(now, met)
        error = np.where(depth > NEAREST, error, np.inf)
        worst = np.zeros(len(points))
        np.maximum.at(worst, number, error)
        settled = worst <= settings.max_error
        positions[points[settled]] = met[settled]
        left[open_rows[settled[number]]] = True
        better = ~settled[number] & (error < worst[number])
        enough = np.bincount(number[better], minlength=len(points)) >= settings.min_views
        open_rows = open_rows[better & enough[number]]
    return left, positions


def _lookers(
    positions: Float64[np.ndarray, "s 3"],
    center_views: Int[np.ndarray, " s"],
    pairs: Sequence[tuple[int, int]],
    sightings: Sequence[Sighting],
) -> Int[np.ndarray, " s"]:
    """For each point, the number of views compared with its center's view that have the point inside their image."""
    count = np.zeros(len(positions), np.int64)
    by_view = [np.flatnonzero(center_views == view) for view in range(len(sightings))]
    for first, second in pairs:
        for own, other in ((first, second), (second, first)):
            view, pose = sightings[other].view, sightings[other].camera_from_frame
            count[by_view[own]] += in_image(view.camera, pose, positions[by_view[own]])
    return count


def _twins(
    centers: Int[np.ndarray, " s"],
    features: Int[np.ndarray, " o"],
    points: Int[np.ndarray, " o"],
    seen: Int[np.ndarray, " s"],
    good: Bool[np.ndarray, " s"],
) -> Bool[np.ndarray, " s"]:
    """Points whose center also belongs to a good point of more views, or to an earlier one of equally many."""
    rank = np.empty(len(centers), np.int64)
    rank[np.lexsort((np.arange(len(centers)), -np.where(good, seen, 0)))] = np.arange(len(centers))
    of_good = good[points]
    best = np.full(max(features.max(initial=-1), centers.max(initial=-1)) + 1, len(centers))
    np.minimum.at(best, features[of_good], rank[points[of_good]])
    return best[centers] < rank


def _gathered(
    sightings: Sequence[Sighting],
    view_of: Int[np.ndarray, " n"],
    features: Int[np.ndarray, " o"],
    observations: Observations,
    positions: Float64[np.ndarray, "s 3"],
    good: Bool[np.ndarray, " s"],
) -> TriangulatedPoints:
    number = np.cumsum(good) - 1
    kept = good[observations.point]
    features, observations = features[kept], observations.where(kept)
    point, count = number[observations.point], int(good.sum())
    _, depth = reprojection_errors(observations, positions)
    pixel_sizes = np.full(count, np.inf)
    np.minimum.at(pixel_sizes, point, depth / observations.focal)
    colors = np.concatenate([np.zeros((0, 3), np.float32), *(sighting.colors for sighting in sightings)])[features]
    # A view in which a channel is cut off at white counts where no other shows the point.
    weights = np.where((colors >= WHITE / 255).any(1), 1e-6, 1.0)
    mean = summed(weights[:, None] * colors, point, count)
    mean /= np.maximum(np.bincount(point, weights, minlength=count), 1e-12)[:, None]
    pixels = np.concatenate([np.zeros((0, 2)), *(sighting.features.pixels for sighting in sightings)])[features]
    return TriangulatedPoints(
        positions[good].astype(np.float32),
        mean.astype(np.float32),
        pixel_sizes.astype(np.float32),
        point,
        view_of[features],
        pixels.astype(np.float32),
    )
