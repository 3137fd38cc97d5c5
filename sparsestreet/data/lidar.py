"""Lidar points and images: the colors that points take from pixels, and the depth they give to them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from sparsestreet.atomic import check_regular
from sparsestreet.data.images import WHITE
from sparsestreet.data.lazy import Frames, Sweeps, spread
from sparsestreet.data.log import DrivingLog, Split
from sparsestreet.data.problems import attempt, fault
from sparsestreet.geometry.boxes import CarriedPoints, without_frames
from sparsestreet.geometry.cameras import project
from sparsestreet.metrics.definitions import LIDAR_REACH
from sparsestreet.types import Camera, Frame, Sweep

_NEAREST = 1e-3
"""Meters."""
_FARTHEST = 1000.0
"""Meters: no street lidar reaches this far, so a point beyond it is not a point."""


def check_points(points: Float64[Tensor, "n 3"], path: Path, *, remedy: str = "drop these returns") -> None:
    """Raise LogError, naming the file, unless all points, in the frame of their sensor, are where lidar can see.

    Those at the sensor itself pass: many drivers write zeros where nothing came back (``returned``).
    """
    # A NaN compares false, so it counts as broken too.
    broken = int((~(points.abs() <= _FARTHEST)).any(-1).sum())
    if broken:
        message = f"{broken} of {points.shape[0]} points are NaN, infinite or more than {_FARTHEST:g} m away"
        raise fault(path, message, remedy)


def unit_intensities(values: np.ndarray, brightest: float | None) -> Float[Tensor, " n"]:
    """Return intensities in [0, 1] of a sweep's own numbers: what is above the brightest is cut off, what is no number
    is 0. None: the brightest is 255 in a sweep with any above 1, and else 1."""
    numbers = np.nan_to_num(values.astype(np.float32))
    if brightest is None:
        brightest = 255.0 if (numbers > 1).any() else 1.0
    return torch.from_numpy(numbers / np.float32(brightest)).clamp(0, 1)


def sensor_returns(
    path: Path, columns: int, brightest: float, *, max_bytes: int, remedy: str
) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Points and intensities of rows of float32, which begin with x, y, z, intensity.

    Raises LogError, naming the file, for one that has none."""
    try:
        size = path.stat().st_size
        if size % (4 * columns) or size > max_bytes:
            message = f"{size} bytes are no whole number of rows of {columns} float32, or more than {max_bytes}"
            raise fault(path, message, remedy)
        check_regular(path)
        rows = np.fromfile(path, dtype="<f4").reshape(-1, columns)
    except OSError as error:
        raise fault(path, f"the sweep cannot be read ({error})", remedy) from error
    points = torch.from_numpy(rows[:, :3].copy()).double()
    check_points(points, path, remedy=remedy)
    return points, unit_intensities(rows[:, 3], brightest)


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
    cameras see a point the first one counts in whose image it is not cut off at white. As in DriveStudio nothing tests
    whether the camera's view of the point is blocked: lidar and cameras sit close together. But the recording car
    (``Frame.ego``) hides points.
    """
    colors = torch.full((points.shape[0], 3), 0.5)
    colored, cut_off = torch.zeros(2, points.shape[0], dtype=torch.bool)
    for frame, seen in zip(frames, places or [points] * len(frames), strict=True):
        rows, pixels, _ = visible_pixels(frame.camera, seen, frame.ego)
        shown = frame.image.reshape(-1, 3)[pixels]
        white = (shown >= WHITE).any(-1)
        new = ~colored[rows] | (cut_off[rows] & ~white)
        colors[rows[new]], cut_off[rows[new]] = shown[new].float() / 255, white[new]
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


def recolored(log: DrivingLog, parts: Split) -> Sweeps:
    """The log's sweeps, colored by training views and by no other image, and carried to these by no held-out box; an
    instant without such a view keeps its own colors."""
    frames, tracks = parts.train, without_frames(log.tracks, parts.held_out_indices)
    places: dict[int, list[int]] = {}
    for place, view in enumerate(frames.views):
        places.setdefault(view.indices[0], []).append(place)

    def carried(sweep: Sweep) -> CarriedPoints:
        return CarriedPoints(sweep.points, sweep.time, sweep.index, tracks)

    def load(index: int) -> Sweep:
        if index not in places:
            return log.sweeps.load(index)
        sweep, seen = log.sweeps.load_gray(index), list(frames.at(places[index]))
        at = [carried(sweep).at(frame.time) for frame in seen]
        colors, colored = color_points(sweep.points, seen, at)
        return replace(sweep, colors=colors, colored=colored)

    def load_gray(index: int) -> Sweep:
        sweep, views = log.sweeps.load_gray(index), frames.at(places.get(index, [])).views
        if not views:
            return sweep
        at = [carried(sweep).at(view.time) for view in views]
        return replace(sweep, colored=seen_points(sweep.points, [view.camera for view in views], at))

    return Sweeps(log.sweeps.indices, load, load_gray, load_intensities=log.sweeps.load_intensities)


MAX_FRAMES = 36
"""Images that are looked at, in half a second: embedded streets of 240x144 that fit have -0.3 to 0.4 pixels right."""
MIN_EDGES = 300
"""Of one direction; fewer say nothing."""
REACH, STEP = 4.0, 0.5
"""Pixels: shifts from -REACH to REACH are tried."""
WIDEST_GAP = 4.0
"""Pixels between two neighboring returns with an edge in between."""
FARTHEST = 40.0
"""Meters of the nearer return of an edge."""


@dataclass(frozen=True)
class EdgeShift:
    """Where the images' edges lie, seen from those of the lidar; pixels of the images as they are read."""

    right: float
    down: float
    edges: int


def edge_shift(frames: Frames, sweeps: Sweeps) -> EdgeShift | None:
    """The shifts, right and down, at which edges of the lidar meet the steepest colors; None where too few are seen.

    An edge lies midway between two returns of a row (or column) of pixels of which one is clearly nearer. The mean
    slope of the gray image at all of them is largest where they belong; a parabola through the best shift and its
    neighbors gives parts of a step. Lidars stand above cameras and look over edges, so ``down`` is -0.4 to -1.0
    where all is right.
    """
    places = {index: place for place, index in enumerate(sweeps.indices)}
    shifts = torch.arange(-REACH, REACH + STEP / 2, STEP)
    slopes, counts = torch.zeros(2, len(shifts)), [0, 0]
    for place in spread(len(frames), MAX_FRAMES):
        index, _ = frames.views[place].indices
        if index not in places:
            continue
        frame = frames[place]
        positions, depths, inside = project(frame.camera, sweeps[places[index]].points)
        if frame.ego is not None:
            column, row = positions[inside].long().unbind(1)
            inside[inside.clone()] = ~frame.ego[row, column]
        for axis in (0, 1):
            edges = _edges(positions[inside], depths[inside], axis, frame)
            slopes[axis] += _slopes(frame, edges, axis, shifts)
            counts[axis] += len(edges)
    if min(counts) < MIN_EDGES:
        return None
    return EdgeShift(_peak(slopes[0], shifts), _peak(slopes[1], shifts), sum(counts))


def _edges(positions: Float[Tensor, "n 2"], depths: Float[Tensor, " n"], axis: int, frame: Frame) -> Tensor:
    """Image positions of the edges along an axis (0: x), far enough from the border to be shifted."""
    lines = positions[:, 1 - axis].floor()
    order = torch.argsort(lines.double() * 1e6 + positions[:, axis].double())
    positions, depths, lines = positions[order], depths[order], lines[order]
    gaps = positions[1:, axis] - positions[:-1, axis]
    nearer, farther = torch.minimum(depths[1:], depths[:-1]), torch.maximum(depths[1:], depths[:-1])
    neighbors = (lines[1:] == lines[:-1]) & (gaps > 0) & (gaps <= WIDEST_GAP)
    found = neighbors & (farther > 1.15 * nearer + 0.5) & (nearer < FARTHEST)
    middles = (positions[1:] + positions[:-1])[found] / 2
    border = torch.tensor([frame.camera.width, frame.camera.height]) - REACH - 1
    return middles[((middles > REACH + 1) & (middles < border)).all(1)]


def _slopes(frame: Frame, edges: Float[Tensor, "n 2"], axis: int, shifts: Float[Tensor, " s"]) -> Float[Tensor, " s"]:
    """Sum of the gray image's slope along the axis at the edges, for each shift along it."""
    slope = torch.gradient(frame.image.float().mean(-1), dim=1 - axis)[0].abs()
    at = edges.expand(len(shifts), *edges.shape).clone()
    at[..., axis] += shifts[:, None]
    size = torch.tensor([frame.camera.width, frame.camera.height])
    return grid_sample(slope[None, None], (2 * at / size - 1)[None], align_corners=False)[0, 0].sum(1)


def _peak(slopes: Float[Tensor, " s"], shifts: Float[Tensor, " s"]) -> float:
    best = int(slopes.argmax())
    if best in (0, len(shifts) - 1):
        return float(shifts[best])
    before, here, behind = slopes[best - 1 : best + 2].tolist()
    return float(shifts[best]) + STEP * (before - behind) / (2 * (before - 2 * here + behind))
