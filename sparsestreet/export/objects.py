"""The objects of a scene: where each shows best, and each as a file with its poses, as game engines move them."""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from sparsestreet.atomic import atomic_folder
from sparsestreet.data.lazy import spread
from sparsestreet.export.frame import selected, turned
from sparsestreet.export.ply import plain_factors, scene_gaussians, spread_cameras, write_ply
from sparsestreet.export.shapes import object_hull
from sparsestreet.geometry.cameras import project
from sparsestreet.geometry.meshes import ply_bytes
from sparsestreet.scene.edits.ground import ground_mesh
from sparsestreet.scene.nodes import Tracked
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

_LOOKS = 12
"""Instants at which an object is looked at for ``plain_factors``."""
_MARGIN = 0.25
"""Share of a box's picture that is shown around it, on each side."""


@dataclass(frozen=True)
class SceneObject:
    """One object of a scene."""

    name: str
    class_name: str
    """As the log calls it; "" in scenes that were trained before their files said it."""
    node: str
    size: tuple[float, float, float]
    """Length, width, height, meters."""
    gaussians: int
    span: tuple[float, float]
    """Normalized times of its first and last appearance."""
    view: View | None
    """That shows it largest; None: none does."""
    box: tuple[int, int, int, int] | None
    """Its place there: left, top, right, bottom, pixels."""


@torch.no_grad()
def scene_objects(stored: StoredScene, views: Sequence[View]) -> list[SceneObject]:
    """All objects of the scene, largest in some view first."""
    found: list[tuple[float, SceneObject]] = []
    for name, node in stored.scene.nodes.items():
        if not isinstance(node, Tracked):
            continue
        places = [_boxes(node, view) for view in views]
        counts = node.instances().counts().tolist()
        for number, track in enumerate(node.names):
            areas = [_area(boxes[number]) for boxes in places]
            best = int(np.argmax(areas)) if areas else 0
            seen = bool(areas) and areas[best] > 0
            row = SceneObject(
                track,
                node.classes[number],
                name,
                _triple(node.sizes[number].tolist()),
                counts[number],
                (float(node.spans[number, 0]), float(node.spans[number, 1])),
                views[best] if seen else None,
                places[best][number] if seen else None,
            )
            found.append((areas[best] if seen else 0.0, row))
    return [row for _, row in sorted(found, key=lambda pair: (-pair[0], pair[1].name))]


def portrait(stored: StoredScene, one: SceneObject) -> UInt8[np.ndarray, "h w 3"] | None:
    """The scene's picture of an object where it is largest, with a margin; None of one that no view shows."""
    if one.view is None or one.box is None:
        return None
    image = stored.render(replace(one.view)).rgb.clamp(0, 1)
    left, top, right, bottom = one.box
    wide, high = round(_MARGIN * (right - left)) + 1, round(_MARGIN * (bottom - top)) + 1
    part = image[max(top - high, 0) : bottom + high, max(left - wide, 0) : right + wide]
    return (part * 255).round().byte().cpu().numpy()


def _boxes(node: Tracked, view: View) -> list[tuple[int, int, int, int] | None]:
    """For each object, the rectangle around its box in the image; None where it is not there or not in the image."""
    poses = node.pose_at(view.time)
    frames, sizes = node.object_frames(poses), node.sizes.double().cpu().numpy()
    present = poses.present.tolist()
    # The frame of a person is at the pelvis, so that its box is a little too high: good enough for a picture.
    return [
        _rectangle(view, frame, size) if there else None
        for frame, size, there in zip(frames, sizes, present, strict=True)
    ]


def _rectangle(
    view: View, frame: Float64[np.ndarray, "4 4"], size: Float64[np.ndarray, "3"]
) -> tuple[int, int, int, int] | None:
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    corners = (signs * size) @ frame[:3, :3].T + frame[:3, 3]
    pixels, depths, _ = project(view.camera, torch.from_numpy(corners).float())
    if float(depths.min()) <= 0.5:
        return None
    low, high = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    left, top = max(int(low[0]), 0), max(int(low[1]), 0)
    right, bottom = min(int(high[0]) + 1, view.camera.width), min(int(high[1]) + 1, view.camera.height)
    return (left, top, right, bottom) if right > left and bottom > top else None


def _area(box: tuple[int, int, int, int] | None) -> float:
    return 0.0 if box is None else float((box[2] - box[0]) * (box[3] - box[1]))


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


POSES, GROUND = "poses.json", "ground.ply"


@torch.no_grad()
def write_objects(folder: Path, stored: StoredScene, views: Sequence[View]) -> list[str]:
    """Write a .ply for each object and one for all that stands still, and ``poses.json``; return the objects' names.

    Beside them are meshes for physics: the hull of each object, in the object's frame, and the ground where it is
    known. An object that no recorded instant shows is left out.

    A .ply is for viewers that do not antialias (``plain_factors``), and has x ahead, y left, z up from the middle
    of the object's box, meters; of a body, as it stands in the middle of its time. Poses are those of the recorded
    instants at which the object is there. The whole folder is written, or nothing. Raises ValueError for a scene
    without objects, OSError where the folder is there and not empty.
    """
    instants, settings = _instants(views), stored.options.settings
    objects = []
    with atomic_folder(folder) as temporary:
        for name, node in stored.scene.nodes.items():
            if isinstance(node, Tracked):
                for number in range(len(node.names)):
                    objects += _object(temporary, stored, name, node, number, instants, len(objects))
        if not objects:
            raise ValueError("the scene has no objects of their own: export it as one .ply")
        still = [name for name, node in stored.scene.nodes.items() if not isinstance(node, Tracked)]
        if still:
            found = scene_gaussians(stored, instants[0].time, nodes=still)
            factors = plain_factors([(found, spread_cameras(views))], settings)
            write_ply(temporary / "still.ply", replace(found, opacities=found.opacities * factors))
        ground = ground_mesh(stored.scene, views)
        if ground is not None:
            (temporary / GROUND).write_bytes(ply_bytes(ground.mesh))
        described = {
            "axes": "x ahead, y left, z up; meters; quaternions wxyz",
            "still": "still.ply" if still else None,
            "ground": None if ground is None else GROUND,
            "objects": objects,
        }
        (temporary / POSES).write_text(json.dumps(described, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [one["name"] for one in objects]


def _instants(views: Sequence[View]) -> list[View]:
    """A view of each recorded frame, in order."""
    return sorted({view.frame_index: view for view in views}.values(), key=lambda view: view.time)


def _object(
    folder: Path, stored: StoredScene, node_name: str, node: Tracked, number: int, instants: Sequence[View], place: int
) -> list[dict[str, Any]]:
    """Write an object, and return what is said of it; nothing of one that is never there."""
    frames = [(view, node.pose_at(view.time)) for view in instants]
    there = [(view, node.object_frames(poses)[number]) for view, poses in frames if bool(poses.present[number])]
    if not there:
        return []
    view, world_from_object = there[len(there) // 2]
    found = scene_gaussians(stored, view.time, nodes=[node_name])
    rows = (node.rows.instances == number) & (found.opacities > 0)
    if not bool(rows.any()):
        return []
    looks = [there[place][0] for place in spread(len(there), _LOOKS)]
    seen = [(scene_gaussians(stored, look.time, nodes=[node_name]), [look.camera]) for look in looks]
    factors = plain_factors(seen, stored.options.settings)
    own = selected(replace(found, opacities=found.opacities * factors), rows)
    turn = torch.from_numpy(world_from_object[:3, :3]).to(own.means)
    shift = torch.from_numpy(world_from_object[:3, 3]).to(own.means)
    shape = object_hull(selected(found, rows), node, number, world_from_object)
    file, hull_file = f"{place:03d}.ply", f"{place:03d}_hull.ply"
    (folder / hull_file).write_bytes(ply_bytes(shape.mesh))
    moved = turned(replace(own, means=own.means - shift), turn.T)
    count = write_ply(folder / file, moved)
    return [
        {
            "name": node.names[number],
            "class": node.classes[number],
            "node": node_name,
            "file": file,
            "gaussians": count,
            "hull": hull_file,
            "hull_is_box": shape.is_box,
            "size": node.sizes[number].tolist(),
            "shape_of": view.time,
            "poses": [_pose(view, frame) for view, frame in there],
        }
    ]


def _pose(view: View, frame: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    return {"time": view.time, "seconds": view.seconds, "stamp": view.stamp, "world_from_object": frame.tolist()}
