"""The objects of a scene: what each is, when it is there, and the view that shows it best."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from sparsestreet.geometry.cameras import project
from sparsestreet.scene.nodes import Tracked
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

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
