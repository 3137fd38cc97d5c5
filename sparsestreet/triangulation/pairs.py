"""Chooses which images to compare: those that look at the same space from places far enough apart."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int

from sparsestreet.geometry.cameras import project
from sparsestreet.triangulation.matches import NEAREST
from sparsestreet.types import Camera, View

SAME_CAMERA = (0.6, 2.0)
"""Distances, meters: each image is compared with the next one of its camera that is at least this far away.

Near ones look alike, far ones give parallax. At 8 m/s and 10 Hz these are the first and the third next image."""

OTHER_CAMERA = (0.0, 3.0)
"""The same for every other camera of the rig: at the same instant, and later, when it looks where this one looked."""

LEAST_BASELINE = 0.05
"""Least distance of two images, meters; nearer ones have no parallax."""

PROBE_DEPTHS = (6.0, 15.0, 40.0)
"""Depths, meters, at which a street has surfaces."""

PROBE_GRID = (5, 4)
"""Columns and rows of rays through an image. The points at all depths on these rays are the image's probes."""

LEAST_OVERLAP = 0.1
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
            if away[second] >= LEAST_BASELINE and (second, first) not in found:
                seen = in_image(views[second].camera, cameras_from_frame[second], probes)
                if seen.mean() >= LEAST_OVERLAP:
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
