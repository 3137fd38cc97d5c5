"""Depth of what lies far ahead of a moving camera: a plane sweep over images from 6 to 18 m apart.

Each pixel takes the plane on which other images look most alike around it (Collins 1996, with planes along the walls of
a street as in Gallup et al. 2007). A point counts where two neighboring swept views say the same.
"""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from torch import Tensor

from sparsestreet.data.lazy import Frames
from sparsestreet.data.lidar import near_returns
from sparsestreet.geometry.boxes import box_at, through_box
from sparsestreet.geometry.cameras import inverse, project, resized
from sparsestreet.geometry.lenses import distort
from sparsestreet.triangulation.points import TriangulatedPoints
from sparsestreet.triangulation.settings import ENLARGEMENT, SweepSettings
from sparsestreet.types import Camera, Frame, Track, View

log = logging.getLogger(__name__)


BASELINES = (6.0, 12.0, 18.0)
"""Meters: a swept view is compared with the first views before and after it that are at least this far away."""
MAX_BASELINE = 27.0
"""Meters; beyond a longer gap in the drive nothing is compared."""
MIN_ALONG = 0.9
"""Least cosine between the optical axis and the way to a compared view, and between the axes of the two. Sideways
cameras see the facades that lidar sees; far things lie ahead."""
LATERAL = 3.0, 45.0, 110
"""Offsets of planes along the street, meters: the least, the largest, and how many at equal ratios, of 1.025."""
FRONTAL = 5.0, 32
"""The least depth of planes across the view, meters, and how many at equal steps of its inverse up to the farthest."""
WINDOW = 5
"""Pixels: side of the square that is compared."""
RIVAL = 1.12, 0.05
"""A depth that differs by more than this factor must score less by so much: patterns repeat along a wall."""
AGREEMENT = 0.05, 2, 3
"""Relative difference of depths that agree, how many neighbors must, of how many swept before and as many after."""
NEAR_RETURNS = 0.005
"""Share of the longer side of an image within which a return says more than the sweep: planes are 2.5 % apart."""
_EPSILON = 1e-7
"""Added to the product of two variances of gray, so that evenly painted things look like nothing."""


@dataclass(frozen=True)
class _Image:
    """A view at the size that is swept, without its lens."""

    view: View
    camera: Camera
    gray: Float32[np.ndarray, "h w"]
    """In [-0.5, 0.5]."""
    colors: UInt8[np.ndarray, "h w 3"]
    solid: Bool[np.ndarray, "h w"]
    """Neither sky nor recording car."""
    measured: Bool[Tensor, "rows columns"] | None
    """Pixels of the image as it was recorded that lie near a return; None: no lidar."""


def swept_points(
    frames: Frames,
    moving: Sequence[Track],
    settings: SweepSettings,
    threads: int = 1,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> TriangulatedPoints:
    """Return the far points on which swept views agree; none if no camera looks along its way.

    A point is observed once, by the view whose pixel it belongs to. The shutter is ignored: what the car drives while
    an image is read out is little beside the distance of two images.

    Args:
        frames: training views.
        moving: objects that move on their own; nothing is found through their boxes.
        settings: limits of the search.
        threads: that work at once; each needs about 2.6 kB a pixel of the compared images.
        report: is told how many of how many views are swept.
    """
    plan = partners(frames.views, settings.step)
    needed = sorted({place for first, others in plan.items() for place in (first, *others)})

    def depth(first: int) -> Float32[np.ndarray, "h w"]:
        return _depth(images[first], [images[other] for other in plan[first]], settings)

    with ThreadPoolExecutor(threads) as executor:
        read = executor.map(lambda place: _image(frames[place], settings.width), needed)
        images = dict(zip(needed, read, strict=True))
        depths = {}
        for place, found in zip(plan, executor.map(depth, plan), strict=True):
            depths[place] = found
            report(len(depths), len(plan))
    parts = [_points(images[place], place, _agreed(place, images, depths), moving) for place in plan]
    points = TriangulatedPoints.concatenate([_NOTHING, *parts])
    log.info("points far ahead from %d of %d images: %d", len(plan), len(frames), len(points))
    return points


def thinned(points: TriangulatedPoints, spacing: float) -> TriangulatedPoints:
    """Return of the points in each cube of so many meters the one with the smallest pixel.

    Raises ValueError if a point is observed more than once.
    """
    if not np.array_equal(points.observed, np.arange(len(points))):
        raise ValueError("thinned takes points that one view each observes: give it those of swept_points")
    order = np.argsort(points.pixel_sizes, kind="stable")
    cubes = np.floor(points.positions[order] / spacing)
    rows = np.sort(order[np.unique(cubes, axis=0, return_index=True)[1]])
    return TriangulatedPoints(
        points.positions[rows],
        points.colors[rows],
        points.pixel_sizes[rows],
        np.arange(len(rows)),
        points.views[rows],
        points.pixels[rows],
    )


_NOTHING = TriangulatedPoints(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.float32),
    np.zeros(0, np.float32),
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 2), np.float32),
)


def partners(views: Sequence[View], step: float) -> dict[int, tuple[int, ...]]:
    """Return the places of the views to sweep, and of each the views of the same camera that it is compared with.

    ``step``: meters from one swept view to the next, at least.
    """
    centers = np.array([view.camera.position.double().numpy() for view in views]).reshape(-1, 3)
    axes = np.array([view.camera.camera_from_world[2, :3].double().numpy() for view in views]).reshape(-1, 3)
    found: dict[int, tuple[int, ...]] = {}
    for camera in sorted({view.indices[1] for view in views}):
        own = [place for place, view in enumerate(views) if view.indices[1] == camera]
        own.sort(key=lambda place: views[place].indices[0])
        last = None
        for at, first in enumerate(own):
            if last is not None and np.linalg.norm(centers[first] - centers[last]) < step:
                continue
            others = [*_compared(first, own[at + 1 :], centers, axes), *_compared(first, own[:at][::-1], centers, axes)]
            if len(others) >= 2:
                found[first] = tuple(others)
                last = first
    return found


def _compared(
    first: int, candidates: Sequence[int], centers: Float64[np.ndarray, "v 3"], axes: Float64[np.ndarray, "v 3"]
) -> list[int]:
    """The first of the candidates beyond each of the baselines, where it looks and lies along the view's axis."""
    ways = centers[list(candidates)] - centers[first]
    away = np.linalg.norm(ways, axis=1)
    chosen = {int(beyond[0]) for baseline in BASELINES if len(beyond := np.flatnonzero(away >= baseline))}
    along = np.abs(ways @ axes[first]) >= MIN_ALONG * away
    alike = axes[list(candidates)] @ axes[first] >= MIN_ALONG
    return [
        candidates[place] for place in sorted(chosen) if along[place] and alike[place] and away[place] <= MAX_BASELINE
    ]


def swept_size(camera: Camera, width: int) -> tuple[int, int]:
    """Return height and width of a camera's images as they are swept, at most ``width`` columns wide."""
    columns = min(width, camera.width)
    return max(round(camera.height * columns / camera.width), 1), columns


def _image(frame: Frame, width: int) -> _Image:
    camera = resized(replace(frame.camera, distortion=None, shutter=None), *swept_size(frame.camera, width))
    colors = frame.image.numpy()
    hidden = np.zeros(colors.shape[:2], np.uint8)
    for mask in (frame.sky, frame.ego):
        hidden |= 0 if mask is None else mask.numpy().astype(np.uint8)
    colors = cv2.resize(colors, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    hidden = cv2.resize(hidden, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    if frame.camera.distortion is not None:
        columns, rows = _through_lens(camera, frame.camera.distortion)
        colors = cv2.remap(colors, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        hidden = cv2.remap(hidden, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
    gray = cv2.cvtColor(colors, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255 - np.float32(0.5)
    view = View(frame.camera, frame.time, frame.frame_index, frame.camera_index, frame.seconds, frame.stamp)
    measured = None if frame.depth is None else near_returns(frame.depth, NEAR_RETURNS)
    return _Image(view, camera, gray, colors, hidden == 0, measured)


def _through_lens(
    camera: Camera, distortion: Float[Tensor, "5"]
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Columns and rows, from the top left pixel's center, where a lens shows what the pixels of a pinhole show."""
    slopes = torch.from_numpy(_rays(camera)[..., :2])
    shown = distort(slopes, distortion.to(slopes)).numpy()
    intrinsics = _intrinsics(camera)
    at = (shown @ intrinsics[:2, :2].T + intrinsics[:2, 2] - 0.5).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])


def _intrinsics(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    return camera.intrinsics.double().numpy()


def _rays(camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Rays (x, y, 1) in the camera through the pixel centers of a pinhole."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack((columns, rows, np.ones_like(columns)), -1) @ np.linalg.inv(_intrinsics(camera)).T


def _depth(image: _Image, others: Sequence[_Image], settings: SweepSettings) -> Float32[np.ndarray, "h w"]:
    """Depth along the optical axis, meters; 0 where no plane stands out."""
    planes = _planes(image, others, settings)
    scores = np.full(planes.shape, -1, np.float32)
    mean, contrast = _moments(image.gray)
    warps = [_Warp.between(image.camera, other.camera) for other in others]
    for depth, score in zip(planes, scores, strict=True):
        best = second = np.full(depth.shape, -1, np.float32)
        for warp, other in zip(warps, others, strict=True):
            alike = _correlation(image.gray, mean, contrast, warp.seen_at(depth, other.gray))
            best, second = np.maximum(best, alike), np.maximum(second, np.minimum(best, alike))
        score[:] = (best + second) / 2
    first = scores.argmax(0)
    depth = np.take_along_axis(planes, first[None], 0)[0]
    score = np.take_along_axis(scores, first[None], 0)[0]
    rival = np.where(np.abs(np.log(planes / depth)) > np.log(RIVAL[0]), scores, -1).max(0)
    counts = image.solid & (score > settings.min_score) & (score - rival > RIVAL[1])
    counts &= (depth > settings.nearest) & (depth < settings.farthest)
    return np.where(counts, depth, 0).astype(np.float32)


def _planes(image: _Image, others: Sequence[_Image], settings: SweepSettings) -> Float32[np.ndarray, "p h w"]:
    """Depths of the pixels on each plane: those along the way on both sides of it, and those across the view."""
    rays = _rays(image.camera)
    ways = [
        _relative(image.camera, inverse(other.camera.camera_from_world.double()).numpy())[:3, 3] for other in others
    ]
    along = sum(np.copysign(1, way[2]) * way for way in ways)
    across = np.cross((0, 1, 0), along)
    aside = np.abs(rays @ (across / np.linalg.norm(across)))
    lateral = np.geomspace(*LATERAL)[:, None, None] / np.maximum(aside, 1e-6)
    nearest, count = FRONTAL
    frontal = 1 / np.linspace(1 / nearest, 1 / settings.farthest, count)
    return np.concatenate((lateral, np.broadcast_to(frontal[:, None, None], (count, *aside.shape)))).astype(np.float32)


def _relative(camera: Camera, world_from_other: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    return camera.camera_from_world.double().numpy() @ world_from_other


@dataclass(frozen=True)
class _Warp:
    """Where another camera sees the pixels of a first one, by their depth."""

    turned: Float32[np.ndarray, "3 h w"]
    """Homogeneous pixels of the other camera, for each meter of depth,"""
    shift: Float32[np.ndarray, "3 1 1"]
    """and at no depth."""

    @staticmethod
    def between(camera: Camera, other: Camera) -> "_Warp":
        other_from_camera = _relative(other, inverse(camera.camera_from_world.double()).numpy())
        intrinsics = _intrinsics(other)
        turned = _rays(camera) @ (intrinsics @ other_from_camera[:3, :3]).T
        shift = intrinsics @ other_from_camera[:3, 3]
        return _Warp(turned.transpose(2, 0, 1).astype(np.float32), shift[:, None, None].astype(np.float32))

    def seen_at(
        self, depth: Float32[np.ndarray, "h w"], gray: Float32[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w"]:
        """The other image as the first one would show it if it had these depths; 0 outside of it."""
        column, row, ahead = self.turned * depth + self.shift
        ahead = np.where(ahead > 1, 1 / np.maximum(ahead, 1), -1)  # behind it: outside of its image
        half = np.float32(0.5)
        return cv2.remap(
            gray, column * ahead - half, row * ahead - half, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )


def _mean(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    return cv2.boxFilter(values, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)


def _moments(gray: Float32[np.ndarray, "h w"]) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Mean and variance in the window around each pixel."""
    mean = _mean(gray)
    return mean, np.maximum(_mean(gray * gray) - mean * mean, 0)


def _correlation(
    gray: Float32[np.ndarray, "h w"],
    mean: Float32[np.ndarray, "h w"],
    contrast: Float32[np.ndarray, "h w"],
    other: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Normalized cross-correlation of the windows of two images, of the first with its moments."""
    other_mean, other_contrast = _moments(other)
    covariance = _mean(gray * other) - mean * other_mean
    return covariance / np.sqrt(contrast * other_contrast + _EPSILON)


def _agreed(
    place: int, images: dict[int, _Image], depths: dict[int, Float32[np.ndarray, "h w"]]
) -> Float32[np.ndarray, "h w"]:
    """The depths of a view that enough of its camera's neighboring swept views share; 0 elsewhere."""
    tolerance, enough, reach = AGREEMENT
    own = [other for other in depths if images[other].view.camera_index == images[place].view.camera_index]
    at = own.index(place)
    depth, camera = depths[place], images[place].camera
    rows, columns = np.nonzero(depth)
    points = torch.from_numpy(_world(camera, _rays(camera)[rows, columns] * depth[rows, columns, None]))
    agreeing = np.zeros(len(rows), np.int64)
    for other in [*own[max(at - reach, 0) : at], *own[at + 1 : at + 1 + reach]]:
        pixels, ahead, inside = (each.numpy() for each in project(images[other].camera, points))
        column, row = pixels[inside].astype(np.int64).T
        said = depths[other][row, column]
        agreeing[inside] += np.abs(said - ahead[inside]) < tolerance * ahead[inside]
    kept = agreeing >= enough
    agreed = np.zeros_like(depth)
    agreed[rows[kept], columns[kept]] = depth[rows[kept], columns[kept]]
    return agreed


def _world(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    world_from_camera = inverse(camera.camera_from_world.double()).numpy()
    return points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]


def _points(
    image: _Image, place: int, depth: Float32[np.ndarray, "h w"], moving: Sequence[Track]
) -> TriangulatedPoints:
    """The points of a view with these depths that no moving box may hide, that its lens shows and no lidar measured."""
    rows, columns = np.nonzero(depth)
    rays = _rays(image.camera)[rows, columns]
    pose, view = image.camera.camera_from_world.double(), image.view
    positions = torch.from_numpy(_world(image.camera, rays * depth[rows, columns, None]))
    pixels, depths, counts = project(view.camera, positions)
    for track in moving:
        world_from_box = box_at(track, view.indices[0], view.time)
        if world_from_box is not None:
            counts &= ~through_box(pose @ world_from_box, torch.from_numpy(rays), ENLARGEMENT * track.size)
    if image.measured is not None:
        column, row = pixels[counts].long().unbind(1)
        counts[counts.clone()] = ~image.measured[row, column]
    sizes, count = depths / view.camera.intrinsics[0, 0], int(counts.sum())
    return TriangulatedPoints(
        positions[counts].float().numpy(),
        image.colors[rows, columns][counts.numpy()].astype(np.float32) / 255,
        sizes[counts].float().numpy(),
        np.arange(count),
        np.full(count, place),
        pixels[counts].float().numpy(),
    )
