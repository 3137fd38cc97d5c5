"""The part of a log that training sees, from which nodes start."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.data.lidar import depth_image, near_returns
from sparsestreet.data.log import DrivingLog
from sparsestreet.triangulation import StreetPoints, TriangulatedPoints
from sparsestreet.types import Frame, Track, View


@dataclass(frozen=True)
class TrainingData:
    """The training part of a log, and the objects that nodes move."""

    log: DrivingLog
    frames: Frames
    """Views to train on; pixels are read when a view is indexed."""
    held_out: frozenset[int]
    """Integer frames whose sweeps and boxes must not be used."""
    tracks: tuple[Track, ...] = ()
    """The objects that were assigned to the node that is built."""
    moving: tuple[Track, ...] = ()
    """The objects of all nodes; points in their boxes belong to no static node."""
    image_points: StreetPoints | None = None
    """Points triangulated from ``frames``; None if the run makes none."""

    @property
    def views(self) -> Sequence[View]:
        """Cameras and times of the training views, without pixels."""
        return self.frames.views

    @property
    def times(self) -> Sequence[float]:
        """Normalized times of the training frames, in order: of each the time of its first view."""
        first: dict[int, float] = {}
        for view in self.views:
            index, _ = view.indices
            first[index] = min(view.time, first.get(index, view.time))
        return sorted(first.values())

    @property
    def sweeps(self) -> Sweeps:
        """Lidar of the training instants; a sweep is read when it is indexed."""
        return self.log.sweeps.where(lambda index: index not in self.held_out)


VIEWS = 48
"""Number of training views that are measured, spread evenly; neighbors show nearly the same."""


@dataclass(frozen=True)
class Coverage:
    """Shares of the pixels that are neither sky nor the recording car; they add up to 1.

    >>> Coverage(lidar=0.5, images=0.25).nothing
    0.25
    """

    lidar: float
    """Share near a return."""
    images: float
    """Share beyond the lidar that is near a point from images seen there."""

    @property
    def nothing(self) -> float:
        """Share near neither."""
        return 1 - self.lidar - self.images


def coverage(data: TrainingData) -> Coverage:
    """Return the coverage of training views; "near" is the window of ``near_returns``. No pixels: all is uncovered."""
    static = None if data.image_points is None else data.image_points.static
    sparse = None if data.log.sparse_points is None else data.log.sparse_points()
    pixels = by_lidar = by_images = 0
    for place in spread(len(data.frames), VIEWS):
        frame = data.frames[place]
        solid = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        for mask in (frame.sky, frame.ego):
            solid = solid if mask is None else solid & ~mask
        returned = _near_lidar(frame) & solid
        pixels += int(solid.sum())
        by_lidar += int(returned.sum())
        shown = torch.zeros_like(solid) if static is None else _near_points(static, place, frame)
        if sparse is not None:  # of these nobody knows whether something hides them
            shown = shown | near_returns(depth_image(sparse.positions, frame.camera))
        by_images += int((shown & solid & ~returned).sum())
    return Coverage(by_lidar / max(pixels, 1), by_images / max(pixels, 1))


def beyond_lidar(data: TrainingData, points: TriangulatedPoints) -> Bool[Tensor, " n"]:
    """Return whether no view that shows a point has a return near it."""
    seen_near = torch.zeros(len(points), dtype=torch.bool)
    for place in range(len(data.frames)):
        own = points.views == place
        row, column = _shown_at(points, own)
        observed = torch.from_numpy(points.observed[own])
        seen_near[observed[_near_lidar(data.frames[place])[row, column]]] = True
    return ~seen_near


def _near_lidar(frame: Frame) -> Bool[Tensor, "h w"]:
    if frame.depth is None:
        return torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    return near_returns(frame.depth)


def _near_points(points: TriangulatedPoints, place: int, frame: Frame) -> Bool[Tensor, "h w"]:
    shown = torch.zeros(frame.image.shape[:2])
    shown[_shown_at(points, points.views == place)] = 1
    return near_returns(shown)


def _shown_at(
    points: TriangulatedPoints, observations: Bool[np.ndarray, " o"]
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Return row and column of the pixels of some observations."""
    column, row = torch.from_numpy(points.pixels[observations]).long().unbind(1)
    return row, column
