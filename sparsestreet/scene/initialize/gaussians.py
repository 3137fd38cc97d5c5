"""Makes a table of Gaussians from colored points."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.geometry.boxes import box_at, inside_box
from sparsestreet.geometry.cameras import inverse, transform_points
from sparsestreet.geometry.quaternions import normalized
from sparsestreet.ops.spherical_harmonics import of_colors
from sparsestreet.scene.gaussians import Rows
from sparsestreet.types import Sweep, Track


@dataclass(frozen=True)
class Points:
    """Positions in meters and RGB in [0, 1].

    >>> points = Points(torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.ones(2, 3))
    >>> len(points.where(points.positions[:, 0] > 0.5))
    1
    """

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]

    def __len__(self) -> int:
        return self.positions.shape[0]

    def where(self, rows: Bool[Tensor, " n"] | Int[Tensor, " k"]) -> "Points":
        """Return the points that a mask tells, or those of some rows, in that order."""
        return Points(self.positions[rows], self.colors[rows])

    def sampled(self, limit: int, generator: torch.Generator) -> "Points":
        """Return at most ``limit`` of the points, drawn without replacement."""
        return self.where(at_most(limit, torch.arange(len(self)), generator))

    @staticmethod
    def concatenate(parts: Sequence["Points"]) -> "Points":
        empty = torch.zeros(0, 3)
        return Points(
            torch.cat([empty, *(part.positions for part in parts)]),
            torch.cat([empty, *(part.colors for part in parts)]),
        )


def at_most(limit: int, rows: Int[Tensor, " n"], generator: torch.Generator) -> Int[Tensor, " k"]:
    """Return all rows if there are at most ``limit``, else ``limit`` of them, drawn without replacement.

    >>> len(at_most(2, torch.arange(5), torch.Generator().manual_seed(0)))
    2
    """
    return rows if len(rows) <= limit else rows[torch.randperm(len(rows), generator=generator)[:limit]]


def thinned(positions: Float[Tensor, "n 3"], voxel: float, generator: torch.Generator) -> Int[Tensor, " k"]:
    """Return the rows of one random point of each cube with side ``voxel`` meters, in random order.

    >>> positions = torch.tensor([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [1.5, 0.0, 0.0]])
    >>> len(thinned(positions, 1.0, torch.Generator().manual_seed(0)))
    2
    """
    order = torch.randperm(len(positions), generator=generator)
    cubes = (positions[order].double() / voxel).floor().long()
    distinct, cube = torch.unique(cubes, dim=0, return_inverse=True)
    # Take the first point of each cube in the random order.
    first = torch.full((len(distinct),), len(order)).scatter_reduce(0, cube, torch.arange(len(order)), "amin")
    return order[first.sort().values]


def returns_in_box_frame(track: Track, sweep: Sweep) -> Float[Tensor, "n 3"] | None:
    """Return a sweep in the track's box frame at its time, meters; None if the track has no box in its frame."""
    world_from_object = box_at(track, sweep.index, sweep.time)
    return None if world_from_object is None else _in_frame(world_from_object, sweep.points)


def outside_boxes(tracks: Sequence[Track], sweep: Sweep, enlargement: float) -> Bool[Tensor, " n"]:
    """Return whether the points of a sweep lie in none of the tracks' boxes at its time."""
    outside = torch.ones(sweep.points.shape[0], dtype=torch.bool)
    for track in tracks:
        in_box_frame = returns_in_box_frame(track, sweep)
        if in_box_frame is not None:
            outside &= ~inside_box(in_box_frame, track.size, enlargement)
    return outside


def outside_swept_boxes(
    tracks: Sequence[Track], points: Float[Tensor, "n 3"], held_out: frozenset[int] = frozenset()
) -> Bool[Tensor, " n"]:
    """Return whether world points lie in none of the tracks' boxes at any frame, those held out left aside."""
    outside = torch.ones(points.shape[0], dtype=torch.bool)
    for track in tracks:
        centers = track.world_from_object[:, :3, 3].to(points.dtype)
        reach = track.size.norm() / 2
        # Few points lie near the path of an object; only these are taken to its boxes, of which there are many.
        near = ((points >= centers.amin(0) - reach) & (points <= centers.amax(0) + reach)).all(1).nonzero().flatten()
        for frame, world_from_object in zip(track.frames.tolist(), track.world_from_object, strict=True):
            if frame not in held_out:
                outside[near[inside_box(_in_frame(world_from_object, points[near]), track.size)]] = False
    return outside


def box_surface_points(count: int, size: Float[Tensor, "3"], generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Return random points on the faces of a box about the origin, spread evenly over its area.

    >>> size = torch.tensor([4.0, 2.0, 1.5])
    >>> points = box_surface_points(10, size, torch.Generator().manual_seed(0))
    >>> bool(((2 * points.abs() / size).amax(1) == 1).all())
    True
    """
    length, width, height = size.tolist()
    areas = torch.tensor([width * height, length * height, length * width])
    axis = torch.multinomial(areas, count, replacement=True, generator=generator)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * size
    side = torch.where(torch.rand(count, generator=generator) < 0.5, -0.5, 0.5)
    points[torch.arange(count), axis] = side * size[axis]
    return points


def lidar_in_boxes(tracks: Sequence[Track], sweeps: Iterable[Sweep]) -> list[Points]:
    """Return for each object the colored returns inside its box at their own instant, in the box frame.

    It passes once over the sweeps, which may be read from disk on the way.
    """
    parts: list[list[Points]] = [[] for _ in tracks]
    for sweep in sweeps:
        for track, found in zip(tracks, parts, strict=True):
            in_box_frame = returns_in_box_frame(track, sweep)
            if in_box_frame is not None:
                inside = inside_box(in_box_frame, track.size) & sweep.colored
                found.append(Points(in_box_frame, sweep.colors).where(inside))
    return [Points.concatenate(found) for found in parts]


def _in_frame(world_from_object: Float64[Tensor, "4 4"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return transform_points(inverse(world_from_object), points.double()).to(points.dtype)


SIDE = 0.5
"""Meters; a plane is fitted to the returns in each cube. 1 m bridges curbs: 0.25 dB less at 3 m beside the path
(docs/moved_views.md)."""
THICKNESS = 0.05
"""Meters; returns whose distances from their plane have a larger standard deviation lie in none. Lidars have 2 cm,
poses as much."""
FEWEST = 10
"""Returns a plane is fitted to."""
NARROWEST = 0.2
"""Times what a filled cube has: a smaller standard deviation along the plane is that of a line, such as one beam's."""
_OFFSET = 1 << 20
"""Cubes are counted from -2^20 to 2^20 along each axis, 500 km at 0.5 m."""


@dataclass(frozen=True)
class Planes:
    """The flat pieces, at most one a cube; their cubes in increasing order."""

    cubes: Int[Tensor, " c"]
    centers: Float[Tensor, "c 3"]
    """A point of each plane, world, meters."""
    normals: Float[Tensor, "c 3"]
    """Unit length; z is not negative."""

    def onto(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """The points, those in a cube with a plane moved to the nearest place on it, and its normal; NaN without."""
        cubes = _cubes(points)
        rows = torch.searchsorted(self.cubes, cubes)
        rows = torch.where(rows < len(self.cubes), rows, 0)
        at = torch.nonzero(torch.isin(cubes, self.cubes)).squeeze(-1)
        normals, centers = self.normals[rows[at]], self.centers[rows[at]]
        above = ((points[at] - centers) * normals).sum(1, keepdim=True)
        nowhere = torch.full_like(points, torch.nan)
        return points.index_copy(0, at, points[at] - above * normals), nowhere.index_copy(0, at, normals)


def fit_planes(points: Float[Tensor, "n 3"]) -> Planes:
    """The planes that minimize the squared distances of the points in each cube: eigenvectors of their covariance.

    >>> along = torch.arange(16.0) / 40
    >>> floor = torch.cartesian_prod(along, along, torch.tensor([0.1]))
    >>> fit_planes(floor).normals.abs().round(decimals=3).tolist()
    [[0.0, 0.0, 1.0]]
    """
    cubes, cube, counts = torch.unique(_cubes(points), return_inverse=True, return_counts=True)
    centers = torch.zeros(len(cubes), 3, dtype=torch.float64).index_add_(0, cube, points.double()) / counts[:, None]
    offsets = points.double() - centers[cube]
    products = (offsets[:, :, None] * offsets[:, None, :]).flatten(1)
    sums = torch.zeros(len(cubes), 9, dtype=torch.float64).index_add_(0, cube, products)
    variances, axes = torch.linalg.eigh((sums / counts[:, None]).view(-1, 3, 3))
    thin = variances[:, 0] < THICKNESS**2
    wide = variances[:, 1] > NARROWEST**2 * SIDE**2 / 12
    flat = (counts >= FEWEST) & thin & wide
    normals = axes[flat, :, 0]
    normals = torch.where(normals[:, 2:] < 0, -normals, normals)
    return Planes(cubes[flat], centers[flat].float(), normals.float())


def _cubes(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """One number for each cube."""
    places = (points.double() / SIDE).floor().long() + _OFFSET
    return (places[:, 0] << 42) | (places[:, 1] << 21) | places[:, 2]


MINIMUM_SCALE = 1e-3
"""Meters; coincident points have distance 0, but a scale needs a logarithm."""

DARKEST = 1 / 510
"""Half a gray level. The op cuts colors off at 0, where they have no gradient: a black one would stay black."""

FLAT = 0.01
"""Meters, largest start of a scale across a surface. From 3 mm to 30 mm nothing changes (docs/moved_views.md)."""


def neighbor_scales(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the mean distance to the three nearest other points (or fewer if there are fewer), at least 1 mm.

    A point without any neighbor gets 1 mm.

    >>> neighbor_scales(torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])).tolist()
    [2.0, 2.0]
    """
    num_points = points.shape[0]
    neighbors = min(3, num_points - 1)
    if neighbors < 1:
        return torch.full((num_points,), MINIMUM_SCALE)
    # The nearest is the point itself or a coincident one. Both have distance 0, so the first can be dropped.
    positions = points.double().numpy()
    places = np.arange(2, neighbors + 2)
    distances, _ = KDTree(positions).query(positions, k=places)  # pyright: ignore[reportArgumentType]
    return torch.from_numpy(distances.mean(1)).float().clamp(min=MINIMUM_SCALE)


def init_gaussians(
    points: Float[Tensor, "n 3"],
    colors: Float[Tensor, "n 3"],
    scales: Float[Tensor, " n"],
    *,
    opacities: Float[Tensor, " n"],
    sh_degree: int,
    generator: torch.Generator,
    columns: Mapping[str, Tensor] | None = None,
    mask_columns: Mapping[str, Tensor] | None = None,
    buffers: Mapping[str, Tensor] | None = None,
) -> Rows:
    """Return isotropic Gaussians with random rotations (as in 3DGS), one per point; RGB in [0, 1], scales in meters.

    ``columns`` are further parameters of a node, ``mask_columns`` those that a mask learns, ``buffers`` further data of
    each row. Raises ValueError if an opacity is outside (0, 1) or the degree outside 0 to 3.

    >>> points, start = torch.rand(5, 3), {"opacities": torch.full((5,), 0.1), "sh_degree": 1}
    >>> rows = init_gaussians(points, points, torch.ones(5), generator=torch.Generator(), **start)
    >>> rows.sh_rest.shape
    torch.Size([5, 3, 3])
    """
    if not bool(((opacities > 0) & (opacities < 1)).all()):
        raise ValueError(
            f"initial opacities must lie between 0 and 1, got {float(opacities.min())} to {float(opacities.max())}"
        )
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"spherical harmonics are known up to degree 3, got sh_degree={sh_degree}")
    num_rows = points.shape[0]
    parameters = {
        "means": points.float(),
        "log_scales": scales.float().log()[:, None].expand(-1, 3),
        "quaternions": normalized(torch.randn(num_rows, 4, generator=generator)),
        "opacity_logits": torch.logit(opacities.float()),
        "sh_dc": of_colors(colors.float().clamp(min=DARKEST)),
        "sh_rest": torch.zeros(num_rows, (sh_degree + 1) ** 2 - 1, 3),
    }
    masks = dict(mask_columns or {})
    return Rows(parameters | dict(columns or {}) | masks, buffers, transient=masks.keys())


@torch.no_grad()
def lie_flat(rows: Rows, normals: Float[Tensor, "n 3"]) -> None:
    """Turn the third axis of each Gaussian into its normal and make it thin there; NaN: it stays as it is.

    The rotation is the shortest one from (0, 0, 1), so normals point up: z must not be negative.
    """
    known = normals.isfinite().all(1)
    x, y, z = normals[known].unbind(1)
    # Twice the half angle's cosine and sine along (0, 0, 1) x normal, both times the cosine.
    rows.quaternions[known] = normalized(torch.stack((1 + z, -y, x, torch.zeros_like(z)), 1))
    rows.log_scales[known, 2] = rows.log_scales[known, 2].clamp(max=math.log(FLAT))
