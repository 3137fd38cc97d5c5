"""Measure what moves during an exposure: sheared images, blur, and boxes beside their objects."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.lazy import Sweeps, spread
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse, project, transform_points
from sparsestreet.types import Camera, Shutter, Track, View

MAX_VIEWS = 60
SHEAR_QUANTILE = 0.95
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


def readout_shear(views: Sequence[View], sweeps: Sweeps, quantile: float = SHEAR_QUANTILE) -> ReadoutShear:
    """The shear by the declared motion of the cameras at the lidar's points; without lidar, 10 m away.

    Raises ValueError where no view has a shutter.
    """
    rolling = [view for view in views if view.camera.shutter is not None]
    if not rolling:
        raise ValueError("shear is that of a rolling shutter, and no view has one: ask cameras with Camera.shutter")
    quantiles, points = [], 0
    for view in (rolling[index] for index in spread(len(rolling), MAX_VIEWS)):
        moved = _moved(view.camera, _static_points(view, sweeps))
        if len(moved):
            quantiles.append(moved.quantile(quantile))
            points += len(moved)
    found = torch.stack(quantiles)
    error = float(found.std() / len(found) ** 0.5) if len(found) > 1 else 0.0
    return ReadoutShear(float(found.mean()), error, len(found), points)


def shear_over(view: View, sweeps: Sweeps) -> tuple[Float[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Pixels of the static points that a view with a shutter sees, and by how many pixels each moves meanwhile."""
    world = _static_points(view, sweeps)
    pixels, _, inside = project(view.camera, world)
    return pixels[inside], _moved(view.camera, world)


def _static_points(view: View, sweeps: Sweeps) -> Float[Tensor, "n 3"]:
    """Those of the sweep of its frame, in the world; points 10 m away where there is none."""
    index, _ = view.indices
    if index in sweeps.indices:
        return sweeps[sweeps.indices.index(index)].points
    return _at_distance(view.camera)


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


BLUR_QUANTILE = 0.9
"""Of the points of an image: a tenth of them is blurred by the measured length or more."""


def exposure_motions(views: Sequence[View]) -> dict[tuple[int, int], Shutter]:
    """Frame and camera -> how the camera moves while it is exposed, of images whose exposure is declared.

    From the motion during the readout, where that is declared with its seconds; else from the poses of the images
    before and behind, of the same camera. An image for which neither is there is left out, as is any without a clock.
    """
    by_camera: dict[int, list[View]] = defaultdict(list)
    for view in sorted(views, key=lambda view: view.time):
        by_camera[view.indices[1]].append(view)
    found = {}
    for own in by_camera.values():
        for place, view in enumerate(own):
            around = own[max(place - 1, 0)], own[min(place + 1, len(own) - 1)]
            motion = _exposed(view, *around) if view.camera.exposure > 0 else None
            if motion is not None:
                found[view.indices] = motion
    return found


def blur_length(views: Sequence[View], sweeps: Sweeps, motions: Mapping[tuple[int, int], Shutter]) -> ReadoutShear:
    """Pixels that a tenth of the lidar's points move during the exposure, or more: the mean over images.

    As a shear during the readout is measured. Points on moving objects count as if they stood still.
    """
    exposed = [view for view in views if view.indices in motions]
    moving = [replace(view, camera=replace(view.camera, shutter=motions[view.indices])) for view in exposed]
    return readout_shear(moving, sweeps, BLUR_QUANTILE)


def _exposed(view: View, before: View, behind: View) -> Shutter | None:
    seconds, declared = view.camera.exposure, view.camera.shutter
    if declared is not None and declared.seconds > 0:
        share = seconds / declared.seconds
        parts = share * declared.translation, share * declared.rotation
        return Shutter(*parts, seconds=seconds, span=share * declared.span)
    if before.seconds is None or behind.seconds is None or not behind.seconds > before.seconds:
        return None
    share = seconds / (behind.seconds - before.seconds)
    first, pose, last = (_world_from(each.camera) for each in (before, view, behind))
    turn = quat.to_rotation_vector(quat.from_matrix(last[:3, :3] @ first[:3, :3].T))
    translation, rotation = (share * (pose[:3, :3].T @ each) for each in (last[:3, 3] - first[:3, 3], turn))
    return Shutter(translation.float(), rotation.float(), seconds=seconds, span=share * (behind.time - before.time))


def _world_from(camera: Camera) -> Float[Tensor, "4 4"]:
    return inverse(camera.camera_from_world.double())


ORDERS = 2, 3, 4
"""Of the differences: those of errors are equally large at all orders, those of motion are smaller at higher ones."""
FEWEST = 20
"""Differences of the highest order; fewer say nothing."""
_DEVIATION_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class BoxJitter:
    """Errors of boxes that change from one box to the next. Errors that stay look like another path."""

    value: float
    """Standard deviation of a corner about its path, meters, over the three axes together."""
    error: float
    """Standard error, by objects; NaN of a single one."""
    boxes: int
    by_track: tuple[float, ...]
    """The value of each object that has enough boxes, meters."""


def box_jitter(tracks: Sequence[Track], held_out: frozenset[int]) -> BoxJitter | None:
    """Measure how far corners lie from the paths through their neighbors; None where too few boxes follow each other.

    With differences of order k, over sqrt((2k)! / k!^2), independent errors keep their size. A car that accelerates has
    none of order 3, and at 2 frames a second its jerk has few of order 4. The least of the orders is taken, and of each
    the median, which leaves out strays. ``held_out`` are frames whose boxes are not looked at.
    """
    found = [_differences(track, held_out) for track in tracks]
    found = [each for each in found if len(each[-1])]
    if not found or sum(each[-1].numel() for each in found) < 3 * 8 * FEWEST:
        return None
    without = torch.tensor(
        [_size([*found[:left], *found[left + 1 :]]) for left in range(len(found) * (len(found) > 1))]
    )
    spread = (without - without.mean()).square().sum() * (len(found) - 1) / len(found)
    error = float(spread.sqrt()) if len(found) > 1 else math.nan
    boxes = sum(len(track.frames) for track in tracks)
    return BoxJitter(_size(found), error, boxes, tuple(_size([each]) for each in found))


def _size(found: Sequence[Sequence[Float64[Tensor, "_ 8 3"]]]) -> float:
    by_order = [torch.cat(order).abs().flatten(0, 1).quantile(0.5, dim=0).norm() for order in zip(*found, strict=True)]
    return _DEVIATION_OF_MEDIAN * float(min(by_order))


def _differences(track: Track, held_out: frozenset[int]) -> list[Float64[Tensor, "_ 8 3"]]:
    """Of the corners in the world, at each order, over boxes of frames that follow each other."""
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
    corners = torch.einsum("fij,cj->fci", track.world_from_object[:, :3, :3], signs * track.size.double())
    corners = corners + track.world_from_object[:, None, :3, 3]
    used = torch.tensor([int(frame) not in held_out for frame in track.frames], dtype=torch.bool)
    frames, corners = track.frames[used], corners[used]
    found = []
    for order in ORDERS:
        weights = torch.tensor([(-1.0) ** i * math.comb(order, i) for i in range(order + 1)], dtype=torch.float64)
        if len(frames) <= order:
            found.append(corners[:0])
            continue
        windows = corners.unfold(0, order + 1, 1) @ weights / math.sqrt(math.comb(2 * order, order))
        found.append(windows[frames[order:] - frames[:-order] == order])
    return found
