"""The color of a lidar return, and how far images of other instants agree with it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.data.lidar import visible_pixels
from sparsestreet.training.moved_views.target import unhidden
from sparsestreet.types import Frame


def seen_colors(
    points: Float[Tensor, "n 3"], frames: Sequence[Frame], places: Sequence[Float[Tensor, "n 3"]] | None = None
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
    """RGB of each point in the first image that shows it, and which points one shows.

    ``places``: where the points are in each of the images; None: in all of them where they were measured. Unlike
    ``data.lidar.color_points`` a point behind nearer ones has no color: the lidar stands higher than the cameras and
    looks over cars, whose color such a point would take.
    """
    colors, seen = torch.zeros_like(points), torch.zeros(len(points), dtype=torch.bool)
    for frame, place in zip(frames, places or [points] * len(frames), strict=True):
        rows, positions, _ = unhidden(frame.camera, place)
        column, line = positions.long().unbind(-1)
        if frame.ego is not None:  # the recording car hides what lies behind it
            shown = ~frame.ego[line, column]
            rows, column, line = rows[shown], column[shown], line[shown]
        new = ~seen[rows]
        colors[rows[new]] = frame.image[line[new], column[new]].float() / 255
        seen[rows] = True
    return colors, seen


def agreement(
    points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], others: Sequence[Frame], tolerance: float
) -> Float[Tensor, " n"]:
    """exp(-d / tolerance), d the least difference (mean over channels) to images of other instants; 1 where none shows
    the point.

    A point that stands still has its color in some other image too. One on an object that moves without a box, at an
    edge that lidar and camera see at different places, or on a mirror has not.
    """
    least = torch.full((len(points),), torch.inf)
    for frame in others:
        rows, pixels, _ = visible_pixels(frame.camera, points, frame.ego)
        difference = (frame.image.reshape(-1, 3)[pixels].float() / 255 - colors[rows]).abs().mean(1)
        least[rows] = torch.minimum(least[rows], difference)
    return torch.where(least.isinf(), 1.0, torch.exp(-least / tolerance))
