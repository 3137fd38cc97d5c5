"""Shapes of a street for physics: the hull of each object; hulls, ground and surroundings as one .obj."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.atomic import atomic_file
from sparsestreet.export.frame import selected
from sparsestreet.export.ply import scene_gaussians
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.meshes import Mesh, box_corners, hull, obj_text
from sparsestreet.scene.edits.ground import GroundMesh, ground_mesh
from sparsestreet.scene.loaded_scene import check_numbers
from sparsestreet.scene.nodes import Tracked
from sparsestreet.scene.storage import StoredScene
from sparsestreet.scene.surroundings import surroundings, without_ground
from sparsestreet.types import Gaussians, View

MIN_OPACITY = 0.5
"""Opacity of the Gaussians that a hull is around."""
GROUND = "ground"
"""Name of the ground in an .obj."""
SURROUNDINGS = "surroundings"
"""Name there of what else stands still."""


@dataclass(frozen=True)
class Hull:
    """The shape of an object in its frame: x ahead, y left, z up, the origin in the middle of its box (people: at the
    pelvis)."""

    mesh: Mesh
    is_box: bool
    """Its box, as fewer than four Gaussians of it are opaque, or all in a plane."""


@torch.no_grad()
def object_hull(
    gaussians: Gaussians, node: Tracked, instance: int, world_from_object: Float64[np.ndarray, "4 4"]
) -> Hull:
    """Return the convex hull of the opaque Gaussians of an object, each one standard deviation wide, cut at its box.

    Args:
        gaussians: of the object, in the world.
        node: of the object.
        instance: its number there.
        world_from_object: its frame at their time.
    """
    (length, width, height), stands = node.sizes[instance].tolist(), node.frame_height(instance)
    high = np.array([length / 2, width / 2, height - stands])
    low = np.array([-length / 2, -width / 2, -stands])
    opaque = selected(gaussians, gaussians.opacities > MIN_OPACITY)
    axes = quat.to_matrix(torch.nn.functional.normalize(opaque.quaternions, dim=1)) * opaque.scales[:, None]
    middles = opaque.means[:, None]
    ends = torch.cat([middles + axes.mT, middles - axes.mT], 1).reshape(-1, 3).double().cpu().numpy()
    own = (ends - world_from_object[:3, 3]) @ world_from_object[:3, :3]
    found = hull(own.clip(low, high))
    box = hull(box_corners(low, high))
    assert box is not None  # sizes of boxes are above 0
    return Hull(box if found is None else found, found is None)


@dataclass(frozen=True)
class Shapes:
    """What an .obj holds."""

    ground: GroundMesh | None
    """None: nothing tells where it is."""
    hulls: tuple[str, ...]
    """Names of the objects."""
    boxes: tuple[str, ...]
    """Names of those that show no more than their box."""
    surroundings: Mesh | None
    """None: not asked for, or nothing stands there."""


@torch.no_grad()
def write_shapes(
    path: Path, stored: StoredScene, views: Sequence[View], time: float, voxel: float | None = None
) -> Shapes:
    """Write the ground and the hulls of the objects that are there at a time as one .obj, an object each.

    It has the axes of the street: x ahead, y left, z up; meters. With ``voxel`` (meters), it has the surroundings too.

    Raises ValueError for a time beyond [0, 1], a number that is none, a scene without any, two shapes whose names are
    one word, OSError where the file cannot be written, and what not else as ``surroundings``.
    """
    if not 0 <= time <= 1:
        raise ValueError(f"time runs from 0 (first frame of the log) to 1 (its last), got {time}")
    check_numbers(stored.scene)
    ground = ground_mesh(stored.scene, views)
    around = None if voxel is None else surroundings(stored.scene, views, stored.options, voxel)
    around = around if ground is None or around is None else without_ground(around, ground.mesh)
    found_meshes = {GROUND: None if ground is None else ground.mesh, SURROUNDINGS: around}
    meshes = {name: mesh for name, mesh in found_meshes.items() if mesh is not None}
    boxes = []
    for node_name, node in stored.scene.nodes.items():
        if not isinstance(node, Tracked):
            continue
        found, poses = scene_gaussians(stored, time, nodes=[node_name]), node.pose_at(time)
        frames = node.object_frames(poses)
        for number in torch.nonzero(poses.present).flatten().tolist():
            name, rows = node.names[number], node.rows.instances == number
            if name in meshes:
                raise ValueError(f"two shapes are named {name!r}: rename one")
            shape = object_hull(selected(found, rows), node, number, frames[number])
            meshes[name] = shape.mesh.moved(frames[number])
            boxes += [name] if shape.is_box else []
    if not meshes:
        raise ValueError("nothing tells where the ground is, and no object is there at this time: choose another time")
    with atomic_file(path) as temporary:
        temporary.write_text(obj_text(meshes), encoding="utf-8")
    return Shapes(ground, tuple(name for name in meshes if name not in found_meshes), tuple(boxes), around)
