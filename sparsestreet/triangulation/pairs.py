"""Which images to compare: those that look at the same space from places far enough apart."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64

from sparsestreet.types import View

SAME_CAMERA = (0.6, 2.0)
"""Meters: each image is compared with the next of its camera at least so far away: near ones look alike, far ones give
parallax. At 8 m/s and 10 Hz these are the first and the third."""

OTHER_CAMERA = (0.0, 3.0)
"""Meters, for every other camera of the rig: the same instant, and later, when it looks where this one looked."""

LEAST_BASELINE = 0.05
"""Meters; nearer places give no parallax to tell a distance by."""

PROBE_DEPTHS = (6.0, 15.0, 40.0)
"""Meters ahead of a camera where a street has its surfaces."""

PROBE_GRID = (5, 4)
"""Columns and rows of rays through an image; with the depths, the probes that another image may see."""

LEAST_OVERLAP = 0.1
"""Share of the probes that the other image must see."""


def image_pairs(
    views: Sequence[View], cameras_from_frame: Float64[np.ndarray, "v 4 4"]
) -> list[tuple[int, int]]:
    """Pairs (first, second) of views to compare, each once.

    ``cameras_from_frame`` are the poses in the frame that stands still: the world, or the box of a moving object.
    """
    rotation, translation = cameras_from_frame[:, :3, :3], cameras_from_frame[:, :3, 3]
    centers = -np.einsum("vji,vj->vi", rotation, translation)
    found: dict[tuple[int, int], None] = {}
    for first, view in enumerate(views):
        away = np.linalg.norm(centers - centers[first], axis=1)
        for second in _partners(first, view, views, away):
            if away[second] >= LEAST_BASELINE and _overlap(view, views[second], cameras_from_frame[[first, second]]):
                found[first, second] = None
    return list(found)


def _partners(
    first: int, view: View, views: Sequence[View], away: Float64[np.ndarray, " v"]
) -> Iterator[int]:
    """For each camera, the first view from ``view`` on that is as far away as each of the distances wants."""
    for camera in sorted({other.camera_index for other in views}):
        same = camera == view.camera_index
        later = [
            index
            for index, other in enumerate(views)
            if other.camera_index == camera and other.frame_index >= view.frame_index and index != first
        ]
        for distance in SAME_CAMERA if same else OTHER_CAMERA:
            yield from [index for index in later if away[index] >= distance][:1]


def _overlap(first: View, second: View, cameras_from_frame: Float64[np.ndarray, "2 4 4"]) -> bool:
    """Whether the second view sees enough of what may lie ahead of the first."""
    camera, other = first.camera, second.camera
    columns, rows = (np.arange(count) + 0.5 for count in PROBE_GRID)
    at = np.stack(np.meshgrid(columns / PROBE_GRID[0] * camera.width, rows / PROBE_GRID[1] * camera.height), -1)
    pixels = np.concatenate((at.reshape(-1, 2), np.ones((at.size // 2, 1))), 1)
    rays = pixels @ np.linalg.inv(camera.intrinsics.double().numpy()).T
    probes = np.concatenate([depth * rays for depth in PROBE_DEPTHS])
    second_from_first = cameras_from_frame[1] @ np.linalg.inv(cameras_from_frame[0])
    seen = (probes @ second_from_first[:3, :3].T + second_from_first[:3, 3]) @ other.intrinsics.double().numpy().T
    ahead = seen[:, 2] > 0
    x, y = (seen[:, :2] / np.where(ahead, seen[:, 2], 1)[:, None]).T
    inside = ahead & (x >= 0) & (x < other.width) & (y >= 0) & (y < other.height)
    return bool(inside.mean() >= LEAST_OVERLAP)
