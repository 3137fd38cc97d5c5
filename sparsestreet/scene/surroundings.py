"""What stands around a drive as a mesh: depths of recorded views, fused into signed distances, and their zero (TSDF).

Curless and Levoy 1996, in blocks where any view sees a surface. A voxel has the mean, over the views that see it or
what is just before it, of how far it is in front of the surface, cut off on both sides. Only what views agree on stays.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.demand import DemandError
from sparsestreet.geometry.cameras import distance_to_view, resized
from sparsestreet.geometry.meshes import Mesh
from sparsestreet.ops import median_depth
from sparsestreet.scene.edits.ground import SPACING
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.lidar import EDGE
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.state import RenderOptions
from sparsestreet.types import Camera, View

MIN_VOXEL, MAX_VOXEL = 0.05, 1.0
"""Meters. Depths are not known to less; below two voxels a pole or a curb is lost."""
REACH = 30.0
"""Meters along the optical axis: what is farther off is known to meters only."""
MIN_VIEWS = 3
"""That see a surface at a place. One or two show what only they believe in, and behind an edge nobody sees any."""
MAX_DEPTH_BYTES = 2_000_000_000
"""Of the depths of all views, float32."""
MAX_BLOCKS = 100_000
"""With surfaces in them: their triangles take about a gigabyte."""
MIN_AREA = 1.0
"""Square meters of a piece of the mesh; smaller ones float in the air."""
GROUND_BAND = 0.3
"""Meters above and below the mesh of the ground that belong to it."""
_SIDE = 16
"""Voxels along each edge of a block."""
_PIXELS = 2
"""Of an image for a voxel at the full reach; more show nothing that voxels hold."""
_CLIP, _BEHIND = 1.5, 5.0
"""Voxels at which distances are cut off, and behind a surface up to which it says anything of a voxel. The first makes
the mean a vote, which outliers do not bend; the second bridges depths that differ, and flat views of a road."""
_HIDDEN = 0.98
"""Share of a depth below which an object is in front of it."""
_BATCH = 32
"""Views at once: some 40 MB."""


@dataclass(frozen=True)
class DepthImage:
    """How far what a pinhole camera sees is along its optical axis."""

    depths: Float32[np.ndarray, "h w"]
    """Meters; infinite where nothing is met, NaN where it is not known."""
    camera: Camera

    def __post_init__(self) -> None:
        if (self.depths <= 0).any():
            raise ValueError(f"depths are above 0, got {np.nanmin(self.depths):g}: NaN says that one is not known")


def surroundings(scene: SceneGraph, views: Sequence[View], options: RenderOptions, voxel: float) -> Mesh | None:
    """Return the surface of all that has no track, as views of the drive see it; None where they see none.

    Args:
        scene: of which no number is NaN (``check_numbers``).
        views: of the drive. What an object hides from all but two of them is left out.
        options: how the scene is rendered.
        voxel: meters; half of it is the smallest detail.

    Raises ValueError for a voxel that is too small or too large, DemandError for more than memory is meant to hold,
    ModuleNotFoundError without scikit-image.
    """
    if not MIN_VOXEL <= voxel <= MAX_VOXEL:
        raise ValueError(f"voxel must lie in [{MIN_VOXEL:g}, {MAX_VOXEL:g}] m, got {voxel:g}: 0.2 suits streets")
    _marching_cubes()  # before the work
    still = {name: node for name, node in scene.nodes.items() if not isinstance(node, Tracked)}
    if not still:
        return None
    seen = [replace(view, camera=_small(view.camera, voxel)) for view in views]
    size = 4 * sum(view.camera.width * view.camera.height for view in seen)
    _check(f"depths of {len(seen)} views", size, MAX_DEPTH_BYTES, "bytes")
    return fused([_depths(scene, scene.with_nodes(still), view, options) for view in seen], voxel)


def _small(camera: Camera, voxel: float) -> Camera:
    """Return the camera with no more pixels than voxels need."""
    share = min(1.0, _PIXELS * REACH / voxel / float(camera.intrinsics[0, 0]))
    return resized(camera, max(1, round(share * camera.height)), max(1, round(share * camera.width)))


@torch.no_grad()
def _depths(scene: SceneGraph, still: SceneGraph, view: View, options: RenderOptions) -> DepthImage:
    """Draw what stands still; not known is what is behind objects. Lens and shutter do not matter to a surface."""
    camera = replace(scene.seen(view).camera, distortion=None, shutter=None)
    plain = replace(view, camera=camera)
    depths = _median(still, plain, options)
    if len(still.nodes) < len(scene.nodes):
        nearest = _median(scene, plain, options)
        depths = torch.where(nearest < _HIDDEN * depths, torch.nan, depths)
    return DepthImage(depths.float().cpu().numpy(), camera)


def _median(scene: SceneGraph, view: View, options: RenderOptions) -> Float[Tensor, "h w"]:
    gaussians = scene.gaussians_at(view).gaussians
    return median_depth(gaussians, view.camera, settings=options.settings, backend=options.backend).depth


def fused(images: Sequence[DepthImage], voxel: float) -> Mesh | None:
    """Return the surface that depth images agree on, in the world; None where they show none.

    Raises DemandError where it spans more than ``MAX_BLOCKS``.
    """
    marching_cubes = _marching_cubes()
    if not images:
        return None
    stack = _Stack.of(images)
    blocks = np.unique(np.concatenate([_touched(image, voxel) for image in images]), axis=0)
    _check(f"surfaces in voxels of {voxel:g} m", len(blocks), MAX_BLOCKS, "blocks")
    seen = _seeing(images, blocks, voxel)
    nodes = np.indices([_SIDE + 1] * 3).reshape(3, -1)
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)]
    for number, block in enumerate(blocks):
        start = _SIDE * block
        points = (voxel * (nodes + start[:, None])).astype(np.float32)
        distances, known, sure = stack.distances(np.flatnonzero(seen[:, number]), points, voxel)
        (all_known, _), (_, any_sure), (all_below, any_below) = map(_of_cells, (known, sure, distances < 0))
        cells = np.pad(all_known & any_sure & any_below & ~all_below, [(1, 0)] * 3)  # as marching_cubes numbers them
        if not cells.any():
            continue
        corners, triangles, *_ = marching_cubes(distances, 0.0, mask=cells, allow_degenerate=False)
        faces.append(triangles + sum(map(len, vertices)))
        # A vertex between two blocks is in both, rounded alike.
        vertices.append(np.round(corners.astype(np.float64), 4) + start)
    merged, places = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    return _large_pieces(Mesh(voxel * merged, places.reshape(-1)[np.concatenate(faces)]))


@dataclass(frozen=True)
class _Stack:
    """All images one after the other, with bits of the arithmetic done."""

    images_from_world: Float32[np.ndarray, "v 3 4"]
    """To column and row in units of depth, and depth."""
    widths: Int64[np.ndarray, " v"]
    heights: Int64[np.ndarray, " v"]
    starts: Int64[np.ndarray, " v"]
    nearness: Float32[np.ndarray, " n"]
    """Inverse depths, which are linear across the image of a plane."""

    @classmethod
    def of(cls, images: Sequence[DepthImage]) -> "_Stack":
        cameras = [image.camera for image in images]
        matrices = [(one.intrinsics @ one.camera_from_world[:3]).numpy() for one in cameras]
        heights, widths = np.array([image.depths.shape for image in images]).T
        starts = np.concatenate([[0], np.cumsum(heights * widths)[:-1]])
        nearness = np.concatenate([1 / image.depths.ravel() for image in images])
        return cls(np.stack(matrices), widths, heights, starts, nearness)

    def distances(
        self, views: Int64[np.ndarray, " s"], points: Float32[np.ndarray, "3 n"], voxel: float
    ) -> tuple[Float32[np.ndarray, "k k k"], Bool[np.ndarray, "k k k"], Bool[np.ndarray, "k k k"]]:
        """Return how far a cube of points is before the surface, in units of the cut, where views tell, and where
        enough of them see a surface."""
        count, total, weight = np.zeros((3, points.shape[1]))
        for first in range(0, len(views), _BATCH):
            places, ahead, depths = self._told(views[first : first + _BATCH], points)
            told = ahead > -_BEHIND * voxel
            places, ahead, depths = places[told], ahead[told] / voxel, depths[told]
            # Errors of depths grow with depth; what is far behind a surface may be before another.
            each = np.minimum((ahead + _BEHIND) / (_BEHIND - _CLIP), 1) / depths**2
            count += np.bincount(places[np.abs(ahead) < _CLIP], minlength=len(count))
            weight += np.bincount(places, each, len(count))
            total += np.bincount(places, each * np.clip(ahead / _CLIP, -1, 1), len(count))
        known, cube = weight > 0, [_SIDE + 1] * 3
        mean = np.divide(total, weight, out=np.ones_like(total), where=known).astype(np.float32)
        return mean.reshape(cube), known.reshape(cube), (count >= MIN_VIEWS).reshape(cube)

    def _told(
        self, views: Int64[np.ndarray, " s"], points: Float32[np.ndarray, "3 n"]
    ) -> tuple[Int64[np.ndarray, " m"], Float32[np.ndarray, " m"], Float32[np.ndarray, " m"]]:
        """Return for each pair of a view and a point in its image: the point, how far it is before what is seen there
        (meters, NaN where that is not known), its depth."""
        matrices = self.images_from_world[views]
        column, row, depth = np.moveaxis(matrices[:, :, :3] @ points + matrices[:, :, 3:], 1, 0)
        ahead = np.where(depth > 0, depth, np.nan)
        column, row = column / ahead - 0.5, row / ahead - 0.5
        inside = (column >= 0) & (column < self.widths[views, None] - 1) & (depth < REACH)
        inside &= (row >= 0) & (row < self.heights[views, None] - 1)
        view, place = np.nonzero(inside)
        column, row, depth, view = column[inside], row[inside], depth[inside], views[view]
        left, top, wide = np.floor(column), np.floor(row), self.widths[view]
        right, down = column - left, row - top
        corner = self.starts[view] + top.astype(np.int64) * wide + left.astype(np.int64)
        four = self.nearness[np.stack([corner, corner + 1, corner + wide, corner + wide + 1])]
        between = (1 - down) * (four[0] + right * (four[1] - four[0])) + down * (four[2] + right * (four[3] - four[2]))
        nearest = self.nearness[corner + (down >= 0.5) * wide + (right >= 0.5)]
        with np.errstate(divide="ignore"):
            seen = 1 / np.where(four.max(0) < EDGE * four.min(0), between, nearest)
        return place, seen - depth, depth


def _of_cells(nodes: Bool[np.ndarray, "k k k"]) -> tuple[Bool[np.ndarray, "c c c"], Bool[np.ndarray, "c c c"]]:
    """Return whether all, and whether any, of the eight corners of each cell are true."""
    corners = np.lib.stride_tricks.sliding_window_view(nodes, (2, 2, 2))
    return np.asarray(corners.all((3, 4, 5))), np.asarray(corners.any((3, 4, 5)))


def _touched(image: DepthImage, voxel: float) -> Int64[np.ndarray, "b 3"]:
    """Return the blocks with surfaces that an image shows, and with what is a little before and behind them."""
    row, column = np.nonzero(image.depths < REACH)
    depths = image.depths[row, column].astype(np.float64)
    rays = np.linalg.inv(image.camera.intrinsics.double().numpy()) @ np.stack([column + 0.5, row + 0.5, 0 * row + 1.0])
    pose, found = image.camera.camera_from_world.double().numpy(), []
    for step in (-_CLIP * voxel, 0.0, _CLIP * voxel):
        points = pose[:3, :3].T @ (rays * (depths + step) - pose[:3, 3:])
        found.append(np.unique(np.floor(points.T / (_SIDE * voxel)).astype(np.int64), axis=0))
    return np.concatenate(found)


def _seeing(images: Sequence[DepthImage], blocks: Int64[np.ndarray, "b 3"], voxel: float) -> Bool[np.ndarray, "v b"]:
    """Return which images may see each block within the reach."""
    side = _SIDE * voxel
    centers, radius = torch.from_numpy((blocks + 0.5) * side).float(), side * 3**0.5 / 2
    cameras = [image.camera for image in images]
    ahead = [centers @ one.camera_from_world[2, :3] + one.camera_from_world[2, 3] < REACH + radius for one in cameras]
    near = [distance_to_view(one, centers) < radius for one in cameras]
    return (torch.stack(near) & torch.stack(ahead)).numpy()


def without_ground(mesh: Mesh, ground: Mesh) -> Mesh:
    """Return a mesh without its triangles that are within 0.3 m of the height of the ground below."""
    away, nearest = KDTree(ground.vertices[:, :2]).query(mesh.vertices[:, :2])
    above = mesh.vertices[:, 2] - ground.vertices[nearest, 2]
    return _kept(mesh, ~((np.abs(above) < GROUND_BAND) & (away < SPACING))[mesh.faces].all(1))


def _large_pieces(mesh: Mesh) -> Mesh | None:
    """Return the connected pieces of ``MIN_AREA`` or more; None if there is none."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    ends = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]]).T
    edges = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(len(mesh.vertices),) * 2)
    piece = connected_components(edges, directed=False)[1][mesh.faces[:, 0]]
    large = np.bincount(piece, areas)[piece] >= MIN_AREA
    return _kept(mesh, large) if large.any() else None


def _kept(mesh: Mesh, rows: Bool[np.ndarray, " t"]) -> Mesh:
    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


def _marching_cubes() -> Callable[..., Any]:
    try:
        from skimage.measure import marching_cubes
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"surroundings need {error.name}: pip install 'sparsestreet[mesh]'") from error
    return marching_cubes


def _check(what: str, size: int, most: int, unit: str) -> None:
    """Raise DemandError for more than there may be."""
    if size > most:
        raise DemandError(f"{what} are {size:,} {unit}, more than {most:,}: take larger voxels, or fewer frames")
