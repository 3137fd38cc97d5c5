"""Each object of a scene as a file of its own, and where it is when: what a game engine needs to move them itself."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.atomic import atomic_folder
from sparsestreet.export.frame import selected, turned
from sparsestreet.export.ply import scene_gaussians, write_ply
from sparsestreet.scene.nodes import Tracked
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

POSES = "poses.json"


@torch.no_grad()
def write_objects(folder: Path, stored: StoredScene, views: Sequence[View]) -> list[str]:
    """Writes a .ply for each object and one for all that stands still, and ``poses.json``; returns the objects' names.

    An object that no recorded instant shows is left out.

    A .ply has x ahead, y left, z up from the middle of the object's box, meters; of a body, as it stands in the middle
    of its time. Poses are those of the recorded instants at which the object is there. The whole folder is written, or
    nothing. Raises ValueError for a scene without objects, OSError where the folder is there and not empty.
    """
    instants, antialiased = _instants(views), stored.options.settings.antialias
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
            write_ply(temporary / "still.ply", found, antialiased=antialiased)
        described = {
            "axes": "x ahead, y left, z up; meters; quaternions wxyz",
            "still": "still.ply" if still else None,
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
    """Writes an object, and returns what is said of it; nothing of one that is never there."""
    frames = [(view, node.pose_at(view.time)) for view in instants]
    there = [(view, node.object_frames(poses)[number]) for view, poses in frames if bool(poses.present[number])]
    if not there:
        return []
    view, world_from_object = there[len(there) // 2]
    found = scene_gaussians(stored, view.time, nodes=[node_name])
    rows = (node.rows.instances == number) & (found.opacities > 0)
    if not bool(rows.any()):
        return []
    own = selected(found, rows)
    turn = torch.from_numpy(world_from_object[:3, :3]).to(own.means)
    shift = torch.from_numpy(world_from_object[:3, 3]).to(own.means)
    file = f"{place:03d}.ply"
    moved = turned(replace(own, means=own.means - shift), turn.T)
    count = write_ply(folder / file, moved, antialiased=stored.options.settings.antialias)
    return [
        {
            "name": node.names[number],
            "class": node.classes[number],
            "node": node_name,
            "file": file,
            "gaussians": count,
            "size": node.sizes[number].tolist(),
            "shape_of": view.time,
            "poses": [_pose(view, frame) for view, frame in there],
        }
    ]


def _pose(view: View, frame: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    return {"time": view.time, "seconds": view.seconds, "stamp": view.stamp, "world_from_object": frame.tolist()}
