"""Ranges along the rays of a lidar, drawn by the splat op as it is: a fan of pinhole views around the sensor.

A rendering has a mean depth, which lies between the surfaces that a pixel mixes. A return comes from one surface, so a
range here is the median: the depth of the Gaussian behind which at most half of the light passes (``median_depth``).
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from sparsestreet.finite import check_finite, check_rows
from sparsestreet.geometry.cameras import inverse
from sparsestreet.ops import median_depth
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.state import DEFAULT_OPTIONS, RenderOptions
from sparsestreet.types import Camera, MedianDepth, Sweep, View

VIEWS = 8
"""Level views of 360 / 8 degrees. Twelve see nothing better."""
MAX_ELEVATION = math.radians(50)
"""Of the rays of a level view, up or down; two more views hold steeper ones, if there are any."""
_VIEW_ANGLES = [(2 * math.pi * (view + 0.5) / VIEWS, 0.0) for view in range(VIEWS)]
_VIEW_ANGLES += [(0.0, math.pi / 2), (0.0, -math.pi / 2)]
"""Yaw and pitch of the optical axes, radians: level ones, the zenith and the nadir."""
PIXELS = 2
"""Along each axis from one ray to the next. The op blurs by about a pixel, so one would mix what two rays meet."""
PIXEL = math.radians(0.2)
"""Angle of a pixel that suffices. Finer ones make no smaller errors (docs/metrics.md), and take longer."""
MIN_SPACING = 1e-4
"""Radians between rays, a tenth of the finest lidar's: nobody has the memory for pixels much finer."""
EDGE = 1.2
"""Ratio of the depths of neighboring pixels from which on they show different surfaces."""
MARGIN = 1.5
"""Pixels around the rays of a view: the four around each of them are in the image."""
Pose = Float64[Tensor, "4 4"] | Callable[[float], Float64[Tensor, "4 4"]]
"""world_from_lidar, or what returns it by the seconds since the instant of the sweep."""


@dataclass(frozen=True)
class Rays:
    """Rays of a lidar. Raises ValueError for directions that are no unit vectors, and for impossible spacings."""

    directions: Float[Tensor, "n 3"]
    """Unit vectors in the frame of the lidar: x ahead, y left, z up."""
    world_from_lidar: Pose
    spacing: tuple[float, float]
    """Radians of azimuth, and of elevation, from one ray to the next: they say how fine the views are."""
    seconds: Float[Tensor, " n"] | None = None
    """When each ray is fired, since the instant of the sweep; None: all at that instant."""

    def __post_init__(self) -> None:
        lengths = self.directions.double().norm(dim=-1)
        remedy = "divide directions by their lengths, and drop those of length 0"
        check_rows("the length of a direction", lengths, (lengths - 1).abs() < 1e-3, "must be 1", remedy, row="ray")
        if self.seconds is not None:
            check_finite({"seconds": self.seconds}, "take the times of the lidar's table", row="ray")
        if not all(MIN_SPACING <= one < math.pi for one in self.spacing):
            raise ValueError(f"spacing must lie in [{MIN_SPACING:g}, pi) radians, got {self.spacing}: degrees are none")

    def pose(self, seconds: float) -> Float64[Tensor, "4 4"]:
        """Return world_from_lidar at a time since the instant of the sweep."""
        return self.world_from_lidar(seconds) if callable(self.world_from_lidar) else self.world_from_lidar


MIN_RANGE = 0.5
"""Meters: nearer returns are of the recording car, as in the depth term."""


def rays_to(sweep: Sweep) -> tuple[Int[Tensor, " k"], Float64[Tensor, " k"], Rays]:
    """Return which points of a sweep are not of the recording car, their ranges, and the rays that end there, with the
    axes of the world.

    Raises ValueError for a sweep whose origin is not known.
    """
    if sweep.origin is None:
        raise ValueError(f"nobody knows where the lidar of sweep {sweep.index} stood: leave the sweep out")
    away = sweep.points.double() - sweep.origin
    ranges = away.norm(dim=-1)
    rows = torch.nonzero(ranges > MIN_RANGE).squeeze(-1)
    world_from_lidar = torch.eye(4, dtype=torch.float64)
    world_from_lidar[:3, 3] = sweep.origin
    directions = (away[rows] / ranges[rows, None]).float()
    return rows, ranges[rows], Rays(directions, world_from_lidar, (PIXELS * PIXEL, PIXELS * PIXEL))


@dataclass(frozen=True)
class Ranges:
    """What rays meet, on the device of their directions."""

    ranges: Float[Tensor, " n"]
    """Meters along each ray; infinite where more than half of the light passes all Gaussians."""
    alpha: Float[Tensor, " n"]
    """Coverage up to the Gaussian that is met, or by all of them."""
    rows: Int[Tensor, " n"]
    """Which Gaussian of ``SceneGraph.gaussians_at`` is met in the pixel of each ray; -1: none."""
    seconds: Float64[Tensor, " n"]
    """Since the instant of the sweep: when the view of each ray sees sensor and objects."""

    @property
    def returned(self) -> Bool[Tensor, " n"]:
        """Which rays meet anything."""
        return torch.isfinite(self.ranges)


@torch.no_grad()
def render_ranges(
    scene: SceneGraph,
    rays: Rays,
    time: float,
    options: RenderOptions = DEFAULT_OPTIONS,
    *,
    duration: float | None = None,
) -> Ranges:
    """Draw the median range along each ray, without gradients.

    Rays that were fired at different times are drawn where sensor and objects are at the median time of their view.
    Before and after the log, objects stand still.

    Args:
        scene: what is looked at.
        rays: of a sweep.
        time: normalized time of its instant.
        options: how the scene is rendered.
        duration: seconds of the log from time 0 to 1 (``scene.views.seconds_of``); needed where rays have seconds.

    Raises ValueError for seconds without a duration, a pose that is no rigid motion, Gaussians that are not finite, and
    for what not else as ``ops.splat``.
    """
    if rays.seconds is not None and not (duration and math.isfinite(duration)):
        raise ValueError(
            f"rays with seconds need those of the log from time 0 to 1, got duration {duration}: give them"
        )
    like = rays.directions
    ranges, alpha = like.new_full((len(like),), torch.inf), like.new_zeros(len(like))
    met = torch.full_like(alpha, -1, dtype=torch.int64)
    seconds = torch.zeros_like(alpha, dtype=torch.float64)
    for part in _fan(rays):
        moment = 0.0 if duration is None else part.seconds / duration
        placed = scene.gaussians_at(View(part.camera, min(max(time + moment, 0.0), 1.0)))
        drawn = median_depth(placed.gaussians, part.camera, settings=options.settings, backend=options.backend)
        depths, alphas, rows = _at(drawn, part.positions.to(scene.device))
        ranges[part.rows] = (depths / part.cosines.to(depths)).to(like)
        alpha[part.rows], met[part.rows] = alphas.to(like), rows.to(met.device)
        seconds[part.rows] = part.seconds
    return Ranges(ranges, alpha, met, seconds)


@dataclass(frozen=True)
class _Part:
    """Rays that one view holds."""

    rows: Int[Tensor, " k"]
    camera: Camera
    positions: Float64[Tensor, "k 2"]
    """In the image, pixels."""
    cosines: Float64[Tensor, " k"]
    """Depth along the optical axis per meter along the ray."""
    seconds: float
    """The median over the rays."""


def _fan(rays: Rays) -> Iterator[_Part]:
    """Yield the views that have rays: level ones by azimuth, and those of steep rays."""
    directions = rays.directions.cpu().double()
    x, y, z = directions.unbind(-1)
    turns = torch.remainder(torch.atan2(y, x) / (2 * math.pi), 1.0)
    places = (VIEWS * turns).long().clamp(max=VIEWS - 1)
    steep = z.abs() > math.sin(MAX_ELEVATION)
    places[steep] = torch.where(z[steep] > 0, VIEWS, VIEWS + 1)
    views = 2 * places + _late(rays)
    for view in views.unique().tolist():
        rows = torch.nonzero(views == view).squeeze(-1)
        yield _part(rays, rows, directions[rows], _camera_axes(*_VIEW_ANGLES[view // 2]))


def _late(rays: Rays) -> Bool[Tensor, " n"]:
    """Return which rays are fired in the second half of a turn: it ends where it begins, and no view shows both."""
    if rays.seconds is None or not len(rays.seconds):
        return torch.zeros(len(rays.directions), dtype=torch.bool)
    first, last = rays.seconds.aminmax()
    return (rays.seconds > (first + last) / 2).cpu()


def _camera_axes(yaw: float, pitch: float) -> Float64[Tensor, "3 3"]:
    """Return camera_from_lidar: rows right, down and ahead; ``pitch`` is up from level, radians."""
    ahead = (math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch))
    right = torch.tensor((math.sin(yaw), -math.cos(yaw), 0.0), dtype=torch.float64)
    optical = torch.tensor(ahead, dtype=torch.float64)
    return torch.stack((right, torch.linalg.cross(optical, right), optical))


def _part(
    rays: Rays, rows: Int[Tensor, " k"], directions: Float64[Tensor, "k 3"], axes: Float64[Tensor, "3 3"]
) -> _Part:
    """Make the smallest view with these axes that holds the rays."""
    along = directions @ axes.T
    focal = torch.tensor([PIXELS / one for one in rays.spacing], dtype=torch.float64)
    image = along[:, :2] / along[:, 2:] * focal
    corner = image.amin(0) - MARGIN
    width, height = (image.amax(0) + MARGIN - corner).ceil().int().tolist()
    intrinsics = torch.eye(3, dtype=torch.float64)
    intrinsics[0, 0], intrinsics[1, 1], intrinsics[:2, 2] = focal[0], focal[1], -corner
    seconds = 0.0 if rays.seconds is None else float(rays.seconds[rows].median())
    camera_from_lidar = torch.eye(4, dtype=torch.float64)
    camera_from_lidar[:3, :3] = axes
    camera_from_world = camera_from_lidar @ inverse(rays.pose(seconds).cpu().double())
    camera = Camera(camera_from_world.float(), intrinsics.float(), width, height)
    return _Part(rows.to(rays.directions.device), camera, image - corner, along[:, 2], seconds)


def _at(
    drawn: MedianDepth, positions: Float64[Tensor, "k 2"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"], Int[Tensor, " k"]]:
    """Return depth, coverage and row at image positions.

    Inverse depth is linear across the image of a plane. Where the four pixels around show an edge, the nearest counts.
    """
    depth, alpha = drawn.depth.double(), drawn.alpha.double()
    column, row = positions.long().unbind(-1)
    corner = (positions - 0.5).floor()
    (right, down), (left, top) = (positions - 0.5 - corner).unbind(-1), corner.long().unbind(-1)
    weights = torch.stack(((1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down))
    rows, columns = torch.stack((top, top, top + 1, top + 1)), torch.stack((left, left + 1, left, left + 1))
    four = depth[rows, columns]
    surface = four.amax(0) < EDGE * four.amin(0)
    between = torch.where(surface, 1 / (weights / four).sum(0), depth[row, column])
    mixed = torch.where(surface, (weights * alpha[rows, columns]).sum(0), alpha[row, column])
    return between, mixed, drawn.rows[row, column]
