"""Annotated objects of a sequence that can move, from its XML of cuboids."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64, Int

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
_SEEN = 150.0
"""Meters from the car within which a box that stands still is read. A sequence has thousands over kilometers."""
_AROUND = 300
"""Frames before and after those of its part of the street: the car sees it from afar, but a sequence that comes back
minutes later may find it gone."""
_LARGEST = 1 << 31
"""Bytes; read piece by piece."""
_SHEAR = 1e-3
"""Of the longest side: float32 matrices show 1e-6."""
_REMEDY = "copy it again from the published archive, or remove it to read the sequence without boxes"


@dataclass(frozen=True)
class _Object:
    class_name: str
    window: tuple[int, int]
    """Frames of the 200 m of street in which it was annotated."""
    poses: dict[int, Float64[np.ndarray, "4 4"]] = field(default_factory=dict)
    """By frame; -1: it stands still."""
    sizes: dict[int, Float64[np.ndarray, "3"]] = field(default_factory=dict)


def read_boxes(path: Path, frames: Int[np.ndarray, " f"], positions: Float64[np.ndarray, "f 3"]) -> list[Boxes]:
    """The objects at the frames, which are counted by their place; raises LogError with all at fault.

    A moving object has its boxes at frames of its own. One that stands still has its box at all frames that are near.

    Args:
        path: of the XML.
        frames: that are read, increasing.
        positions: of the car at them, in the world.
    """
    objects: dict[str, _Object] = {}
    problems: list[Problem] = []
    for number, item in enumerate(elements(path, 1, max_bytes=_LARGEST, remedy=_REMEDY)):
        if item.find("transform") is None:
            continue
        try:
            _add(objects, item, path, f"{item.tag} (element {number})")
        except LogError as error:
            problems += error.problems
    if problems:
        raise LogError(problems)
    found = (_boxes(name, one, frames, positions, path) for name, one in objects.items())
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
    found = objects[name] = replace(found, window=(min(start, found.window[0]), max(end, found.window[1])))
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


def _boxes(
    name: str, one: _Object, frames: Int[np.ndarray, " f"], positions: Float64[np.ndarray, "f 3"], path: Path
) -> Boxes | None:
    if one.poses.keys() == {_STATIC}:
        start, end = one.window
        near = np.linalg.norm(positions - one.poses[_STATIC][:3, 3], axis=1) <= _SEEN
        places = np.flatnonzero(near & (frames >= start - _AROUND) & (frames <= end + _AROUND))
        sources = [_STATIC] * len(places)
    else:
        places = np.flatnonzero(np.isin(frames, [stamp for stamp in one.poses if stamp != _STATIC]))
        sources = frames[places].tolist()
    if not sources:
        return None
    poses = np.stack([one.poses[source] for source in sources])
    return Boxes(name, one.class_name, places, poses, np.stack([one.sizes[source] for source in sources]), path)
