"""The ground of a scene: what covers most of a place seen from above, near the feet of objects that were recorded."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.meshes import Mesh, grid_mesh
from sparsestreet.scene.edits.nodes import AddedObject, EditedNode
from sparsestreet.scene.gaussians import Rows
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.types import View

_LAYER = 0.3
"""Meters of height that hold the ground; trees spread over more, and so do guesses below it."""
MIN_GAUSSIANS = 5
"""Around a place, to tell the ground's height by."""
_RADII = (1.0, 2.0, 4.0, 8.0)
"""Meters around a place: the first that has enough Gaussians."""
MAX_AWAY = 20.0
"""Meters within which the feet of objects tell about the ground."""
_PLAY, _RISE = 0.5, 0.1
"""Meters that curbs and boxes are off, and what a street rises a meter at most."""
_BELOW_CAMERA = (0.5, 4.0)
"""Meters from a camera down to the road that it is driven on."""
_BESIDE = 2.0
"""Meters around a camera where there is road, also where no Gaussian tells."""
_AROUND, _FLAT = 4.0, 0.2
"""Meters of road that a plane is laid through, and its width by its length below which it tells no slope across."""
SPACING = 0.5
"""Meters between neighbors of the mesh."""
REACH = 15.0
"""Meters around the drive and the feet of objects that the mesh covers."""
MAX_FROM_DRIVE = 100.0
"""Meters from the drive to the feet of objects that the mesh goes as far as."""
MAX_NODES = 4_000_000
"""Of the grid around it, a square kilometer: more would take gigabytes."""
_HALF = 2
"""Neighbors on each side that a height is smoothed with."""
_MAX_APART = 0.2
"""Meters between the heights of two opposite neighbors; those on both sides of a wall are no pair."""
_MIN_PAIRS, _AGREE = 5, 0.1
"""Pairs of opposite neighbors that fill a hole, and meters within which they agree."""
MAX_STEP = 0.1
"""Meters from one node of the mesh to a neighbor on the same ground, a slope of 20 %: more is a wall or a hedge."""


class Ground:
    """Heights of the ground, of nodes without tracks and of the boxes that stand on it."""

    def __init__(self, scene: SceneGraph) -> None:
        """Read a scene; objects that edits moved or added say nothing of it."""
        still = [node.rows for node in scene.nodes.values() if not isinstance(node, Tracked | EditedNode | AddedObject)]
        tracked = [node for node in scene.nodes.values() if isinstance(node, Tracked)]
        self._feet = np.concatenate([np.zeros((0, 3)), *map(_feet, tracked)])
        self._road = np.zeros((0, 3))
        layers = [(torch.zeros(0, 3), torch.zeros(0)), *map(_flat, still)]
        self._means, self._cover = (torch.cat(columns).double().numpy() for columns in zip(*layers, strict=True))
        self._tree = KDTree(self._means[:, :2])

    def along(self, views: Sequence[View]) -> "Ground":
        """Add the road below recorded cameras to the feet that tell of it: each camera is as high above it all along.

        Its height is the median of what Gaussians tell; a camera of which they tell nothing adds nothing.
        """
        near, far = _BELOW_CAMERA
        cameras: dict[int, list[list[float]]] = {}
        for view in views:
            place = inverse(view.camera.camera_from_world.double())[:3, 3].tolist()
            cameras.setdefault(view.indices[1], []).append(place)
        for places in cameras.values():
            layers = [(z, self._layer(x, y, z - far, z - near, _RADII[:3])) for x, y, z in places]
            heights = [z - layer for z, layer in layers if layer is not None]
            if heights:
                self._road = np.concatenate([self._road, np.array(places) - [0.0, 0.0, float(np.median(heights))]])
        self._feet = np.concatenate([self._feet, self._road])
        return self

    def below(self, x: float, y: float) -> float | None:
        """Return the height of the ground at a place of the world, meters; None where nothing tells.

        It is that of the layer that covers most, seen from above, in the smallest circle that has enough Gaussians.
        Where an object stood within 20 m, the layer is about as high as its feet; without any Gaussians it is that.
        """
        stood = np.linalg.norm(self._feet[:, :2] - [x, y], axis=1)
        if not len(stood) or stood.min() >= MAX_AWAY:
            return self._layer(x, y, -np.inf, np.inf, _RADII)
        feet, play = float(self._feet[stood.argmin(), 2]), _PLAY + _RISE * float(stood.min())
        found = self._layer(x, y, feet - play, feet + play, _RADII)
        return feet if found is None else found

    def off(self, x: float, y: float, z: float) -> float | None:
        """Return how far a place is above the ground (below: negative), meters; None where nothing tells."""
        below = self.below(x, y)
        return None if below is None else z - below

    def grid(self) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "x y"], Bool[np.ndarray, "x y"]]:
        """Return x and y of the first node of a grid around all feet, heights (NaN: nothing tells), and what is near.

        Gaussians within two meters tell; where there are none as near to a camera, a plane through the road
        around.
        """
        feet = self._feet
        if len(self._road):
            feet = feet[KDTree(self._road[:, :2]).query(feet[:, :2])[0] < MAX_FROM_DRIVE]
        corner = SPACING * np.floor((feet[:, :2].min(0) - REACH) / SPACING)
        wide, deep = np.ceil((feet[:, :2].max(0) + REACH - corner) / SPACING).astype(int) + 1
        shape = (int(wide), int(deep))
        if wide * deep > MAX_NODES:
            spans = " x ".join(f"{SPACING * count:.0f}" for count in shape)
            raise ValueError(f"a mesh of the ground spans up to a square kilometer, got {spans} m: take fewer frames")
        places = corner + SPACING * np.indices(shape).reshape(2, -1).T
        away, nearest = map(np.asarray, KDTree(feet[:, :2]).query(places))
        heights = np.full(len(places), np.nan)
        for node in np.flatnonzero(away < REACH):
            stands, play = feet[nearest[node], 2], _PLAY + _RISE * away[node]
            found = self._layer(places[node, 0], places[node, 1], stands - play, stands + play, _RADII[:2])
            heights[node] = np.nan if found is None else found
        told = np.column_stack([places, heights])[np.isfinite(heights)]
        driven, _ = KDTree(self._road[:, :2]).query(places)
        known = np.concatenate([self._road, told])
        around = KDTree(known[:, :2])
        for node in np.flatnonzero(np.isnan(heights) & (driven < _BESIDE)):
            heights[node] = _plane(known[around.query_ball_point(places[node], _AROUND)], places[node])
        return corner, heights.reshape(shape), (away < REACH).reshape(shape)

    def standing(
        self, heights: Float64[np.ndarray, "x y"], corner: Float64[np.ndarray, "2"]
    ) -> Bool[np.ndarray, "x y"]:
        """Return which nodes of a grid something stood on."""
        nodes = np.rint((self._feet[:, :2] - corner) / SPACING).astype(int)
        inside = ((nodes >= 0) & (nodes < heights.shape)).all(1)
        nodes, stands = nodes[inside], self._feet[inside, 2]
        close = np.abs(heights[tuple(nodes.T)] - stands) < _PLAY
        on = np.zeros(heights.shape, dtype=bool)
        on[tuple(nodes[close].T)] = True
        return on

    def _layer(self, x: float, y: float, low: float, high: float, radii: Sequence[float]) -> float | None:
        """Return the height of the layer between two heights, in the first circle that has enough Gaussians."""
        for radius in radii:
            near = np.array(self._tree.query_ball_point((x, y), radius), dtype=np.int64)
            near = near[(self._means[near, 2] > low) & (self._means[near, 2] < high)]
            if len(near) >= MIN_GAUSSIANS:
                return _fullest(self._means[near, 2], self._cover[near])
        return None


@dataclass(frozen=True)
class GroundMesh:
    """The ground as a mesh, and what it was made of."""

    mesh: Mesh
    filled: int
    """Vertices between others that agree, where nothing else tells."""
    left_out: int
    """Nodes near the drive and the feet of objects that are not in it."""


def ground_mesh(scene: SceneGraph, views: Sequence[View]) -> GroundMesh | None:
    """Return the ground near the recorded drive and the feet of objects, in the world; None where nothing tells.

    Heights are smoothed. What cannot be reached from the road below a camera, or from where an object stood, without a
    step of ``MAX_STEP`` is left out. Raises ValueError where the grid would be larger than a square kilometer.
    """
    ground = Ground(scene).along(views)
    if not len(ground._feet):
        return None
    corner, told, near = ground.grid()
    heights = _smoothed(told)
    heights[~_reached(heights, ground.standing(heights, corner))] = np.nan
    mesh, used = grid_mesh(corner, SPACING, heights)
    if not len(mesh.faces):
        return None
    return GroundMesh(mesh, int(np.isnan(told.ravel()[used]).sum()), int(near.sum()) - len(used))


def _plane(points: Float64[np.ndarray, "n 3"], place: Float64[np.ndarray, "2"]) -> float:
    """Return the height of the plane through points at a place; it is level across a line of points."""
    middle = points.mean(0)
    slope = np.linalg.lstsq(points[:, :2] - middle[:2], points[:, 2] - middle[2], rcond=_FLAT)[0]
    return float(middle[2] + (place - middle[:2]) @ slope)


def _smoothed(heights: Float64[np.ndarray, "x y"]) -> Float64[np.ndarray, "x y"]:
    """Return medians of a height and the means of opposite neighbors, which no slope changes; holes are filled."""
    wide, (rows, columns) = np.pad(heights, _HALF, constant_values=np.nan), heights.shape
    half = range(-_HALF, _HALF + 1)
    steps = [(x, y) for x in half for y in half if (x, y) > (0, 0)]

    def shifted(x: int, y: int) -> Float64[np.ndarray, "x y"]:
        return wide[_HALF + x : _HALF + x + rows, _HALF + y : _HALF + y + columns]

    ends = np.stack([[shifted(x, y), shifted(-x, -y)] for x, y in steps])
    pairs = np.where(np.abs(ends[:, 0] - ends[:, 1]) < _MAX_APART, ends.mean(1), np.nan)
    known = np.isfinite(pairs)
    spread = np.max(pairs, 0, where=known, initial=-np.inf) - np.min(pairs, 0, where=known, initial=np.inf)
    use = np.isfinite(heights) | ((known.sum(0) >= _MIN_PAIRS) & (spread < _AGREE))
    found = np.full(heights.shape, np.nan)
    found[use] = np.nanmedian(np.concatenate([heights[None], pairs])[:, use], axis=0)
    return found


def _reached(heights: Float64[np.ndarray, "x y"], start: Bool[np.ndarray, "x y"]) -> Bool[np.ndarray, "x y"]:
    """Return which nodes a way of small steps leads to from any of those to start at."""
    places = np.arange(heights.size).reshape(heights.shape)
    ends = [(places[1:], places[:-1]), (places[:, 1:], places[:, :-1])]
    a, b = (np.concatenate([side.ravel() for side in sides]) for sides in zip(*ends, strict=True))
    small = np.abs(heights.ravel()[a] - heights.ravel()[b]) < MAX_STEP
    ways = coo_array((np.ones(int(small.sum())), (a[small], b[small])), shape=(heights.size, heights.size))
    _, group = connected_components(ways, directed=False)
    return np.isin(group, group[start.ravel()]).reshape(heights.shape)


@torch.no_grad()
def _flat(rows: Rows) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Return the places of Gaussians that fit into a layer, and how much each covers: its area, by its opacity."""
    axes = quat.to_matrix(torch.nn.functional.normalize(rows.quaternions, dim=1)) * rows.log_scales.exp()[:, None]
    (xx, yy, zz), xy = (axes**2).sum(2).T, (axes[:, 0] * axes[:, 1]).sum(1)
    cover = rows.opacity_logits.flatten().sigmoid() * (xx * yy - xy**2).clamp_min(0).sqrt()
    flat = zz.sqrt() < _LAYER
    return rows.means.detach()[flat].cpu(), cover[flat].cpu()


@torch.no_grad()
def _feet(node: Tracked) -> Float64[np.ndarray, "k 3"]:
    """Return where the objects of a node stood at the times of their boxes."""
    heights = np.array([node.frame_height(number) for number in range(len(node.names))])
    found = []
    for time in node.keyframe_times[node.keyframe_valid].unique().tolist():
        poses = node.pose_at(time)
        frames = node.object_frames(poses)[poses.present.cpu().numpy()]
        found.append(frames[:, :3, 3] - heights[poses.present.cpu().numpy(), None] * frames[:, :3, 2])
    return np.concatenate([np.zeros((0, 3)), *found])


def _fullest(heights: Float64[np.ndarray, " n"], cover: Float64[np.ndarray, " n"]) -> float:
    """Return the median height of the layer that covers most."""
    order = np.argsort(heights)
    heights, below = heights[order], np.concatenate([[0.0], np.cumsum(cover[order])])
    ends = np.searchsorted(heights, heights + _LAYER, side="right")
    start = int(np.argmax(below[ends] - below[:-1]))
    return float(np.median(heights[start : ends[start]]))
