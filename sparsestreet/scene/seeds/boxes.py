"""Which points lie in which object's box."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sparsestreet.geometry.transforms import inverse, transform_points
from sparsestreet.types import Track


def moving_tracks(
    tracks: Sequence[Track], min_path_length: float, classes: Sequence[str] | None = None
) -> tuple[Track, ...]:
    """Tracks whose box center moves more than ``min_path_length`` meters; of some classes only, or of all (None)."""
    return tuple(
        track
        for track in tracks
        if track.path_length > min_path_length and (classes is None or track.class_name in classes)
    )


def points_in_box_frame(track: Track, frame: int, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"] | None:
    """World points in the track's box frame at an integer frame, meters; None where it is not annotated."""
    found = torch.nonzero(track.frames == frame).flatten()
    if found.numel() == 0:
        return None
    object_from_world = inverse(track.world_from_object[int(found[0])])
    return transform_points(object_from_world, points.double()).to(points.dtype)


def inside_box(
    points_in_box: Float[Tensor, "n 3"], size: Float[Tensor, "3"], enlargement: float = 1.0
) -> Bool[Tensor, " n"]:
    """Whether points of the box frame lie in the box, its sides multiplied by ``enlargement``."""
    return (points_in_box.abs() <= 0.5 * enlargement * size).all(1)


def outside_boxes(
    tracks: Sequence[Track], frame: int, points: Float[Tensor, "n 3"], enlargement: float
) -> Bool[Tensor, " n"]:
    """Whether world points lie in none of the tracks' boxes at an integer frame."""
    outside = torch.ones(points.shape[0], dtype=torch.bool)
    for track in tracks:
        in_box_frame = points_in_box_frame(track, frame, points)
        if in_box_frame is not None:
            outside &= ~inside_box(in_box_frame, track.size, enlargement)
    return outside
