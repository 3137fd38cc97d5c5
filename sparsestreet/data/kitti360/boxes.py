"""Annotated objects of a sequence that can move, from its XML of cuboids."""

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.kitti.text import numbers
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.data.recording import Boxes
from sparsestreet.data.safe_xml import elements

CLASSES = {
    13: "car",
    14: "truck",
    15: "trailer",
    16: "caravan",
    17: "motorcycle",
    18: "bicycle",
    19: "person",
    20: "rider",
    33: "train",
    34: "bus",
    36: "unknown vehicle",
}
"""The XML counts classes otherwise than the label images do (kitti360Scripts, labels.py: kittiId). Buildings, poles and
whatever else cannot move are passed over."""
_STATIC = -1
_LARGEST = 1 << 31
"""Bytes; read piece by piece."""
_SHEAR = 1e-3
"""Of the longest side: float32 matrices show 1e-6."""
_REMEDY = "copy it again from the published archive, or remove it to read the sequence without boxes"


@dataclass
class _Object:
    class_name: str
    window: tuple[int, int]
    """Frames of the 200 m of street in which it was annotated."""
    poses: dict[int, Float64[np.ndarray, "4 4"]] = field(default_factory=dict)
    """By frame; -1: it stands still."""
    sizes: dict[int, Float64[np.ndarray, "3"]] = field(default_factory=dict)


def read_boxes(path: Path, frames: list[int]) -> list[Boxes]:
    """The objects at the frames, which are counted by their place in the list; raises LogError with all at fault.

    A moving object has its boxes at frames of its own. One that stands still has its box at all of the frames, if it
    was annotated in a part of the street that they touch.
    """
    objects: dict[str, _Object] = {}
    problems: list[Problem] = []
    for number, item in enumerate(elements(path, 1, largest=_LARGEST, remedy=_REMEDY)):
        if item.find("transform") is None:
            continue
        try:
            _add(objects, item, path, f"{item.tag} (element {number})")
        except LogError as error:
            problems += error.problems
    if problems:
        raise LogError(problems)
    places = {frame: place for place, frame in enumerate(frames)}
    found = (_boxes(name, one, places, path) for name, one in objects.items())
    return [boxes for boxes in found if boxes is not None]


def _add(objects: dict[str, _Object], item: Element, path: Path, what: str) -> None:
    keys = ("semanticId", "instanceId", "timestamp", "start_frame", "end_frame")
    values = numbers([(item.findtext(key) or "").strip() for key in keys], path, f"{what}, {', '.join(keys)}")
    if (values % 1).any() or np.abs(values).max() > 1e9:
        raise fault(path, f"{what} has {', '.join(keys)} = {values.tolist()}, which are no integers", _REMEDY)
    semantic, instance, stamp, start, end = map(int, values)
    if semantic not in CLASSES:
        return
    pose, size = _decomposed(_matrix(item, path, what), path, what)
    name = f"{CLASSES[semantic]}-{instance}"
    found = objects.setdefault(name, _Object(CLASSES[semantic], (start, end)))
    found.window = min(start, found.window[0]), max(end, found.window[1])
    found.poses[stamp], found.sizes[stamp] = pose, size


def _matrix(item: Element, path: Path, what: str) -> Float64[np.ndarray, "4 4"]:
    """OpenCV's way to write a matrix."""
    found = numbers((item.findtext("transform/data") or "").split(), path, f"{what}, transform")
    if found.shape != (16,) or not np.array_equal(found[12:], [0, 0, 0, 1]):
        raise fault(path, f"{what} has no 4x4 transform with the last row 0 0 0 1", _REMEDY)
    return found.reshape(4, 4)


def _decomposed(
    matrix: Float64[np.ndarray, "4 4"], path: Path, what: str
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "3"]]:
    """world_from_object, and length, width, height: the matrix scales a unit cube, then turns and moves it."""
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    stretch = right.T @ np.diag(scales) @ right
    size = stretch.diagonal()
    sheared = np.abs(stretch - np.diag(size)).max() > _SHEAR * scales[0]
    if np.linalg.det(matrix[:3, :3]) <= 0 or sheared or scales[-1] < 1e-3 or scales[0] > 200:
        message = f"{what} has a transform that is no rotation of a box: it scales by {size.round(3).tolist()}"
        raise fault(path, message, _REMEDY)
    pose = matrix.copy()
    pose[:3, :3] = left @ right
    return pose, size


def _boxes(name: str, one: _Object, places: dict[int, int], path: Path) -> Boxes | None:
    moving = {frame: frame for frame in one.poses if frame != _STATIC}
    if moving:
        sources = {frame: frame for frame in sorted(moving) if frame in places}
    else:
        near = any(one.window[0] <= frame <= one.window[1] for frame in places)
        sources = dict.fromkeys(places, _STATIC) if near else {}
    if not sources:
        return None
    poses = np.stack([one.poses[source] for source in sources.values()])
    sizes = np.stack([one.sizes[source] for source in sources.values()])
    return Boxes(name, one.class_name, np.array([places[frame] for frame in sources]), poses, sizes, path)
