"""What the training images show, by what could tell where it is: lidar returns, points from images, or nothing."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from sparsestreet.data.lidar import near_returns
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.triangulation import TriangulatedPoints
from sparsestreet.types import Frame

VIEWS = 48
"""Training views that are looked at, spread evenly; neighbors show nearly the same."""


@dataclass(frozen=True)
class Coverage:
    """Shares of the pixels that are not sky; they add up to 1."""

    lidar: float
    """Near a return."""
    images: float
    """Beyond the lidar, and near a point from images that was seen there."""

    @property
    def nothing(self) -> float:
        """Near neither."""
        return 1 - self.lidar - self.images


def coverage(data: TrainingData) -> Coverage:
    """Look at training views; "near" is the window of ``near_returns``. Without any pixel all is uncovered."""
    static = None if data.image_points is None else data.image_points.static
    pixels = by_lidar = by_images = 0
    for place in range(0, len(data.frames), -(-len(data.frames) // VIEWS)):
        frame = data.frames[place]
        solid = torch.ones(frame.image.shape[:2], dtype=torch.bool) if frame.sky is None else ~frame.sky
        returned = _near_lidar(frame) & solid
        pixels += int(solid.sum())
        by_lidar += int(returned.sum())
        if static is not None:
            by_images += int((_near_points(static, place, frame) & solid & ~returned).sum())
    return Coverage(by_lidar / max(pixels, 1), by_images / max(pixels, 1))


def beyond_lidar(data: TrainingData, points: TriangulatedPoints) -> Bool[Tensor, " n"]:
    """Which points no view that shows them has a return near."""
    seen_near = torch.zeros(len(points), dtype=torch.bool)
    order = np.argsort(points.views, kind="stable")
    for place, own in zip(*_runs(points.views[order], order), strict=True):
        column, row = torch.from_numpy(points.pixels[own]).long().unbind(1)
        near = _near_lidar(data.frames[int(place)])
        seen_near[torch.from_numpy(points.observed[own][near[row, column].numpy()])] = True
    return ~seen_near


def _runs(sorted_values: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Distinct values, and for each the entries of ``order`` that belong to it."""
    values, starts = np.unique(sorted_values, return_index=True)
    return values, np.split(order, starts[1:])


def _near_lidar(frame: Frame) -> Bool[Tensor, "h w"]:
    if frame.depth is None:
        return torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    return near_returns(frame.depth)


def _near_points(points: TriangulatedPoints, place: int, frame: Frame) -> Bool[Tensor, "h w"]:
    shown = torch.zeros(frame.image.shape[:2])
    column, row = torch.from_numpy(points.pixels[points.views == place]).long().unbind(1)
    shown[row, column] = 1
    return near_returns(shown)
