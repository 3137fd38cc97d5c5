"""Lidar points and images: the colors that points take from pixels, and the depth they give to them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sparsestreet.data.lazy import spread
from sparsestreet.data.problems import attempt, fault
from sparsestreet.geometry.cameras import project
from sparsestreet.metrics.definitions import LIDAR_REACH
from sparsestreet.types import Camera, Frame

_NEAREST = 1e-3
"""Meters."""
_FARTHEST = 1000.0
"""Meters: no street lidar reaches this far, so a point beyond it is not a point."""


def check_points(points: Float64[Tensor, "n 3"], path: Path, *, remedy: str = "drop these returns") -> None:
    """Raises LogError, naming the file, unless all points, in the frame of their sensor, are where lidar can see.

    Those at the sensor itself pass: many drivers write zeros where nothing came back (``returned``).
    """
    # A NaN compares false, so it counts as broken too.
    broken = int((~(points.abs() <= _FARTHEST)).any(-1).sum())
    if broken:
        message = f"{broken} of {points.shape[0]} points are NaN, infinite or more than {_FARTHEST:g} m away"
        raise fault(path, message, remedy)


def returned(points: Float64[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Return which points, in the frame of their sensor, came back from something: all but those nearer than 1 mm."""
    return ~(points.norm(dim=-1) < _NEAREST)  # NaN is no zero: check_points names it


def empty_notes(read: Callable[[Path], Float64[Tensor, "n 3"]], paths: Sequence[Path]) -> list[str]:
    """Say how many points of some sweeps are no returns; ``read`` gives those of a file in the frame of their sensor.
    Three sweeps are looked at; broken ones are passed over."""
    counts = []
    for place in spread(len(paths), 3):
        points = attempt([], partial(read, paths[place]))
        if points is not None and (empty := int((~returned(points)).sum())):
            counts.append(f"{empty} of {len(points)} in {paths[place].name}")
    said = "points at the sensor itself are no returns and are dropped, such as"
    return [f"{said} {', '.join(counts)}"] if counts else []


def color_points(
    points: Float[Tensor, "n 3"],
    frames: Sequence[Frame],
    places: Sequence[Float[Tensor, "n 3"]] | None = None,
) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]:
    """RGB in [0, 1] from the pixel each point falls into, and which points any camera sees; the others are gray.

    ``places``: where the points are in each of the frames; None: in all of them where they were measured. Where several
    cameras see a point the first one counts. As in DriveStudio nothing tests whether the camera's view
    of the point is blocked: lidar and cameras sit close together. But the recording car (``Frame.ego``) hides points.
    """
    colors = torch.full((points.shape[0], 3), 0.5)
    colored = torch.zeros(points.shape[0], dtype=torch.bool)
    for frame, seen in zip(frames, places or [points] * len(frames), strict=True):
        rows, pixels, _ = visible_pixels(frame.camera, seen, frame.ego)
        new = ~colored[rows]
        colors[rows[new]] = frame.image.reshape(-1, 3)[pixels[new]].float() / 255
        colored[rows] = True
    return colors, colored


def seen_points(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], places: Sequence[Float[Tensor, "n 3"]] | None = None
) -> Bool[Tensor, " n"]:
    """Which points lie in the image of any of the cameras: those that ``color_points`` colors where the recording car
    hides none."""
    seen = torch.zeros(points.shape[0], dtype=torch.bool)
    for camera, place in zip(cameras, places or [points] * len(cameras), strict=True):
        seen[visible_pixels(camera, place)[0]] = True
    return seen


def depth_image(
    points: Float[Tensor, "n 3"], camera: Camera, ego: Bool[Tensor, "h w"] | None = None
) -> Float[Tensor, "h w"]:
    """Depth along the optical axis in meters of the nearest point in each pixel; 0 where there is none, and where the
    recording car hides it."""
    _, pixels, depths = visible_pixels(camera, points, ego)
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest.scatter_reduce_(0, pixels, depths.float(), "amin")
    return torch.where(nearest.isinf(), 0.0, nearest).view(camera.height, camera.width)


def near_returns(depth: Float[Tensor, "h w"], reach: float = LIDAR_REACH) -> Bool[Tensor, "h w"]:
    """Pixels of a depth image that have a return at most round(reach * longer side) columns and rows away."""
    window = 2 * round(reach * max(depth.shape)) + 1
    near = depth > 0
    for _ in range(2):
        # Returns within a line of the window, as the difference of two running sums: its cost is free of the reach.
        returns = torch.nn.functional.pad(near.int(), (window // 2 + 1, window // 2)).cumsum(1)
        near = (returns[:, window:] > returns[:, :-window]).T
    return near


def visible_pixels(
    camera: Camera, points: Float[Tensor, "n 3"], ego: Bool[Tensor, "h w"] | None = None
) -> tuple[Int[Tensor, " v"], Int[Tensor, " v"], Float[Tensor, " v"]]:
    """For the points inside the image: their rows, the pixel (row-major) each falls into, and its depth in meters.

    ``ego``: pixels that show the recording car, which hides what falls into them.
    """
    positions, depths, inside = project(camera, points)
    rows = torch.nonzero(inside).squeeze(-1)
    column, line = positions[rows].long().unbind(-1)
    pixels = line * camera.width + column
    if ego is not None:
        shown = ~ego.flatten()[pixels]
        rows, pixels = rows[shown], pixels[shown]
    return rows, pixels, depths[rows]
