"""Matches features of two images that may be one point of the world: alike, and on each other's epipolar lines."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int, UInt8

from sparsestreet.geometry.cameras import project
from sparsestreet.types import Camera, View

SIFT_WIDTH = 640
"""Width, pixels, below which images are doubled before SIFT, which doubles them again: small ones have few features."""

CONTRAST = 0.01
"""SIFT's contrast threshold; OpenCV's 0.04 finds nothing on evenly painted walls and asphalt."""

EDGE = 20.0
"""SIFT's limit of the ratio of curvatures; OpenCV's 10 drops elongated things such as window frames from the side."""


@dataclass(frozen=True)
class Features:
    """Positions in pixels, the top left pixel's center at (0.5, 0.5), and descriptors of unit length."""

    pixels: Float64[np.ndarray, "n 2"]
    descriptors: Float32[np.ndarray, "n 128"]

    def __len__(self) -> int:
        return len(self.pixels)

    def where(self, mask: Bool[np.ndarray, " n"]) -> "Features":
        return Features(self.pixels[mask], self.descriptors[mask])


def find_features(image: UInt8[np.ndarray, "h w 3"], limit: int) -> Features:
    """Return at most ``limit`` features, those of the strongest contrast."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    zoom = 2 if gray.shape[1] < SIFT_WIDTH else 1
    if zoom > 1:
        gray = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=CONTRAST, edgeThreshold=EDGE)
    points, descriptors = sift.detectAndCompute(gray, None)
    if not points:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV counts from the top left pixel's center.
    pixels = (np.array([point.pt for point in points], np.float64) + 0.5) / zoom
    return Features(pixels, _hellinger(descriptors))


def _hellinger(descriptors: Float32[np.ndarray, "n 128"]) -> Float32[np.ndarray, "n 128"]:
    """Square roots of the normalized histograms (Arandjelovic and Zisserman 2012), which have unit length."""
    total = descriptors.sum(1, keepdims=True)
    return np.sqrt(descriptors / np.maximum(total, np.float32(1e-12)))


SAME_PLACE = 3.0
"""Pixels within which features are the same place: SIFT finds one corner at several scales, which do not compete."""

NEAREST = 0.5
"""Least depth of a point in either camera, meters."""

ROWS_AT_ONCE = 256
"""Features of the first image that are compared at once, so that a table with all of the second fits the cache."""


def guided_matches(
    first: Features,
    second: Features,
    first_rays: Float64[np.ndarray, "n 2"],
    second_rays: Float64[np.ndarray, "m 2"],
    second_from_first: Float64[np.ndarray, "4 4"],
    *,
    tolerance: float,
    ratio: float,
) -> Int[np.ndarray, "k 2"]:
    """Return the rows of features that match each other best along the epipolar line and in front of both cameras.

    Args:
        first, second: features of either image.
        first_rays, second_rays: their normalized image points x/z, y/z.
        second_from_first: relative pose of the cameras, meters.
        tolerance: largest distance from the epipolar line in the second image, in normalized units.
        ratio: largest ratio of a match's distance to that of the second-best match elsewhere on the line (Lowe's test).
    """
    rows, columns = _on_epipolar_lines(first_rays, second_rays, second_from_first, tolerance)
    in_front = _in_front(first_rays[rows], second_rays[columns], second_from_first)
    rows, columns = rows[in_front], columns[in_front]
    distance = _distances(first.descriptors[rows], second.descriptors[columns])
    best, best_back = _least(distance, rows, len(first)), _least(distance, columns, len(second))
    winner = np.zeros(len(first), np.int64)
    winner[rows[distance == best[rows]]] = columns[distance == best[rows]]
    elsewhere = np.abs(second.pixels[columns] - second.pixels[winner[rows]]).max(1, initial=0) > SAME_PLACE
    rival = _least(distance[elsewhere], rows[elsewhere], len(first))
    mutual = (columns == winner[rows]) & (distance == best_back[columns])
    chosen = mutual & (distance < ratio * rival[rows])
    return np.stack((rows[chosen], columns[chosen]), 1)


def _on_epipolar_lines(
    first: Float64[np.ndarray, "n 2"],
    second: Float64[np.ndarray, "m 2"],
    second_from_first: Float64[np.ndarray, "4 4"],
    tolerance: float,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """All pairs (row of the first, row of the second) within the tolerance."""
    rotation, (x, y, z) = second_from_first[:3, :3], second_from_first[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines = _homogeneous(first) @ essential.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    points = _homogeneous(second).T.astype(np.float32)
    none = np.zeros(0, np.int64)
    found = [(none, none)]
    for start in range(0, len(lines), ROWS_AT_ONCE):
        away = np.abs(lines[start : start + ROWS_AT_ONCE].astype(np.float32) @ points)
        rows, columns = np.nonzero(away < tolerance)
        found.append((rows + start, columns))
    rows, columns = zip(*found, strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def _in_front(
    first: Float64[np.ndarray, "k 2"], second: Float64[np.ndarray, "k 2"], second_from_first: Float64[np.ndarray, "4 4"]
) -> Bool[np.ndarray, " k"]:
    """Whether the two rays come closest to each other in front of both cameras.

    It solves a s + t = b u by least squares, with a and b the rays and t the first center, all in the second camera's
    frame.
    """
    a = _homogeneous(first) @ second_from_first[:3, :3].T
    b = _homogeneous(second)
    t = second_from_first[:3, 3]
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    at, bt = a @ t, b @ t
    determinant = np.maximum(aa * bb - ab * ab, 1e-18)
    s, u = (ab * bt - bb * at) / determinant, (aa * bt - ab * at) / determinant
    return (s > NEAREST) & (u > NEAREST)


def _distances(first: Float32[np.ndarray, "k 128"], second: Float32[np.ndarray, "k 128"]) -> Float32[np.ndarray, " k"]:
    """Euclidean distances of unit vectors."""
    return np.sqrt(np.maximum(2 - 2 * np.einsum("kd,kd->k", first, second), 0))


def _least(values: Float32[np.ndarray, " k"], groups: Int[np.ndarray, " k"], count: int) -> Float32[np.ndarray, " n"]:
    """The least value of each group; infinity for an empty group."""
    least = np.full(count, np.inf, np.float32)
    np.minimum.at(least, groups, values)
    return least


def _homogeneous(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.concatenate((points, np.ones((len(points), 1))), 1)


SAME_CAMERA = (0.6, 2.0)
"""Distances, meters: each image is compared with the next one of its camera that is at least this far away.

Near ones look alike, far ones give parallax. At 8 m/s and 10 Hz these are the first and the third next image."""

OTHER_CAMERA = (0.0, 3.0)
"""The same for every other camera of the rig: at the same instant, and later, when it looks where this one looked."""

MIN_BASELINE = 0.05
"""Least distance of two images, meters; nearer ones have no parallax."""

PROBE_DEPTHS = (6.0, 15.0, 40.0)
"""Depths, meters, at which a street has surfaces."""

PROBE_GRID = (5, 4)
"""Columns and rows of rays through an image. The points at all depths on these rays are the image's probes."""

MIN_OVERLAP = 0.1
"""Least share of the probes that the other image must see."""


def image_pairs(views: Sequence[View], cameras_from_frame: Float64[np.ndarray, "v 4 4"]) -> list[tuple[int, int]]:
    """Pairs (first, second) of views to compare, each once; the second is from the same instant or a later one.

    Args:
        views: in the order of their instants.
        cameras_from_frame: poses in the static frame, meters: the world, or the box of a moving object.
    """
    rotation, translation = cameras_from_frame[:, :3, :3], cameras_from_frame[:, :3, 3]
    centers = -np.einsum("vji,vj->vi", rotation, translation)
    instants = np.array([view.frame_index for view in views], np.int64)
    cameras = np.array([view.camera_index for view in views], np.int64)
    found: dict[tuple[int, int], None] = {}
    for first, view in enumerate(views):
        away = np.linalg.norm(centers - centers[first], axis=1)
        probes = (_probes(view.camera) - translation[first]) @ rotation[first]
        for second in _partners(first, instants, cameras, away):
            # Two cameras of one instant choose each other, but their matches must not count twice.
            if away[second] >= MIN_BASELINE and (second, first) not in found:
                seen = in_image(views[second].camera, cameras_from_frame[second], probes)
                if seen.mean() >= MIN_OVERLAP:
                    found[first, second] = None
    return list(found)


def in_image(
    camera: Camera, camera_from_frame: Float64[np.ndarray, "4 4"], points: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether each point lies in the image of a camera at a pose."""
    posed = replace(camera, camera_from_world=torch.from_numpy(camera_from_frame))
    return project(posed, torch.from_numpy(points), near=NEAREST)[2].numpy()


def _partners(
    first: int, instants: Int[np.ndarray, " v"], cameras: Int[np.ndarray, " v"], away: Float64[np.ndarray, " v"]
) -> Iterator[int]:
    """For each camera and each of its distances, the first view from ``first`` on that is at least this far away."""
    later = instants >= instants[first]
    for camera in np.unique(cameras):
        for distance in SAME_CAMERA if camera == cameras[first] else OTHER_CAMERA:
            yield from np.flatnonzero(later & (cameras == camera) & (away >= distance))[:1].tolist()


def _probes(camera: Camera) -> Float64[np.ndarray, "p 3"]:
    """Sample points in the camera's frame that may lie on surfaces, meters; the lens is ignored."""
    columns, rows = (np.arange(count) + 0.5 for count in PROBE_GRID)
    at = np.stack(np.meshgrid(columns / PROBE_GRID[0] * camera.width, rows / PROBE_GRID[1] * camera.height), -1)
    pixels = np.concatenate((at.reshape(-1, 2), np.ones((at.size // 2, 1))), 1)
    rays = pixels @ np.linalg.inv(camera.intrinsics.double().numpy()).T
    return np.concatenate([depth * rays for depth in PROBE_DEPTHS])
