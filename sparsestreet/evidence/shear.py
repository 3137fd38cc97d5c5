"""How far the image of what stands still is sheared while a camera reads it out."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, spread
from sparsestreet.geometry.cameras import project, transform_points
from sparsestreet.types import Camera, Shutter, View

MOST_VIEWS = 60
QUANTILE = 0.95
_USUAL_DISTANCE = 10.0
"""Meters at which points are taken to be where there is no lidar."""
_PLACES = 16
"""Places a side of the image at which they are taken."""


@dataclass(frozen=True)
class ReadoutShear:
    """Motion in the image between the first and the last row (or column) of a readout, at static points."""

    pixels: float
    """The mean over the views of a percentile of each view's points, the 95th unless another is asked for."""
    error: float
    """Standard error of that mean."""
    views: int
    points: int


def readout_shear(views: Sequence[View], sweeps: Sweeps, quantile: float = QUANTILE) -> ReadoutShear:
    """The shear by the declared motion of the cameras at the lidar's points; without lidar, 10 m away.

    Raises ValueError where no view has a shutter.
    """
    rolling = [view for view in views if view.camera.shutter is not None]
    if not rolling:
        raise ValueError("shear is that of a rolling shutter, and no view has one: ask cameras with Camera.shutter")
    places = {index: place for place, index in enumerate(sweeps.indices)}
    quantiles, points = [], 0
    for view in (rolling[index] for index in spread(len(rolling), MOST_VIEWS)):
        index, _ = view.indices
        world = sweeps[places[index]].points if index in places else _at_distance(view.camera)
        moved = _moved(view.camera, world)
        if len(moved):
            quantiles.append(moved.quantile(quantile))
            points += len(moved)
    found = torch.stack(quantiles)
    error = float(found.std() / len(found) ** 0.5) if len(found) > 1 else 0.0
    return ReadoutShear(float(found.mean()), error, len(found), points)


def shear_over(view: View, sweeps: Sweeps) -> tuple[Float[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Pixels of the static points that a view with a shutter sees, and by how many pixels each moves meanwhile."""
    index, _ = view.indices
    places = {index: place for place, index in enumerate(sweeps.indices)}
    world = sweeps[places[index]].points if index in places else _at_distance(view.camera)
    pixels, _, inside = project(view.camera, world)
    return pixels[inside], _moved(view.camera, world)


def _moved(camera: Camera, world: Float[Tensor, "n 3"]) -> Float[Tensor, " m"]:
    """Pixels between the images of the points that the camera sees, at the end of the readout and at its start."""
    _, _, inside = project(camera, world)
    assert camera.shutter is not None  # as those are that were chosen
    seen = transform_points(camera.camera_from_world, world[inside])
    ends = [_pixels(camera, _carried(seen, camera.shutter, side / 2)) for side in (-1, 1)]
    return (ends[1] - ends[0]).norm(dim=1)


def _carried(points: Float[Tensor, "n 3"], shutter: Shutter, fraction: float) -> Float[Tensor, "n 3"]:
    """Points in the camera frame after a fraction of the readout, to first order (docs/effects.md)."""
    turned = torch.linalg.cross(shutter.rotation.expand_as(points), points)
    return points - fraction * (shutter.translation + turned)


def _pixels(camera: Camera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    return (points @ camera.intrinsics.T)[:, :2] / points[:, 2:].clamp(min=0.2)


def _at_distance(camera: Camera) -> Float[Tensor, "n 3"]:
    """Points in the world on a grid over the image."""
    sides = [(torch.arange(_PLACES) + 0.5) * size / _PLACES for size in (camera.width, camera.height)]
    pixels = torch.cartesian_prod(*sides)
    rays = torch.cat((pixels, torch.ones(len(pixels), 1)), 1) @ torch.linalg.inv(camera.intrinsics).T
    return transform_points(torch.linalg.inv(camera.camera_from_world), _USUAL_DISTANCE * rays)
