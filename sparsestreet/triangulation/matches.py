"""Matches features of two images that may be one point of the world: alike, and on each other's epipolar lines."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from sparsestreet.triangulation.features import Features

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
    """Returns the rows of features that match each other best along the epipolar line and in front of both cameras.

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
