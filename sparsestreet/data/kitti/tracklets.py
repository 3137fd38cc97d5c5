"""Annotated objects of a drive from tracklet_labels.xml."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from sparsestreet.data.kitti.oxts import angles_of
from sparsestreet.data.kitti.text import numbers
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.data.roles import role_of
from sparsestreet.data.safe_xml import elements

_LARGEST = 1 << 25
"""Bytes; 15 objects of 100 frames take 0.3 MB."""
_UNSET, _LABELED = 0, 2
"""States of a pose: nobody gave it, or somebody drew it; 1 is interpolated."""
_FARTHEST = 1000.0
"""Meters."""
TYPES = ("Car", "Van", "Truck", "Tram", "Cyclist", "Pedestrian", "Person (sitting)", "Misc")
_OF_ROLES = {"vehicle": "Car", "cyclist": "Cyclist", "pedestrian": "Pedestrian", "other": "Misc"}
_REMEDY = "copy it again from the published archive, or remove it to read the drive without boxes"


@dataclass(frozen=True)
class Tracklet:
    """One object: its frames and, at each, its box in the frame of the lidar."""

    class_name: str
    size: Float64[np.ndarray, "3"]
    """Length, width, height, meters."""
    frames: Int[np.ndarray, " f"]
    lidar_from_object: Float64[Tensor, "f 4 4"]
    """x along the length, y left, z up, from the center."""
    num_unset: int
    """Poses that were left out because nobody gave them."""


def read_tracklets(path: Path) -> list[Tracklet]:
    """In the order of the file; raises LogError with every object at fault."""
    found, problems, announced = [], [], None
    for item in elements(path, 2, max_bytes=_LARGEST, remedy=_REMEDY):
        try:
            if item.tag == "item":
                found.append(_tracklet(item, path, f"object {len(found) + len(problems)}"))
            elif item.tag == "count":
                announced = numbers([item.text or ""], path, "count")[0]
        except LogError as error:
            problems += error.problems
    if not problems and announced != len(found):
        problems.append(Problem(path, f"it announces {announced} objects and holds {len(found)}", _REMEDY))
    if problems:
        raise LogError(problems)
    return found


def object_type(class_name: str) -> str:
    """KITTI's type of a class of any data set.

    >>> object_type("vehicle.car"), object_type("Tram"), object_type("animal")
    ('Car', 'Tram', 'Misc')
    """
    return class_name if class_name in TYPES else _OF_ROLES[role_of(class_name)]


def tracklets_text(objects: Sequence[str]) -> Iterator[bytes]:
    """The file of some ``tracklet_text``."""
    yield b'<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
    yield b'<boost_serialization signature="serialization::archive" version="9">\n<tracklets version="0">\n'
    yield f"<count>{len(objects)}</count><item_version>1</item_version>\n".encode()
    for one in objects:
        yield one.encode()
    yield b"</tracklets>\n</boost_serialization>\n"


def tracklet_text(
    class_name: str, size: Sequence[float], boxes: Mapping[int, Float64[np.ndarray, "4 4"]], what: str
) -> str:
    """One object of the file, with poses that nobody gave where it has none in between.

    Args:
        class_name: one of TYPES.
        size: length, width, height, meters.
        boxes: frame -> lidar_from_object, from the center.
        what: the object, in an error.

    Raises ValueError for a box that lies too far away.
    """
    length, width, height = size
    first, last = min(boxes), max(boxes)
    poses = "".join(
        _pose_text(boxes.get(frame), height, f"{what} at frame {frame}") for frame in range(first, last + 1)
    )
    return (
        f"<item><objectType>{class_name}</objectType><h>{height!r}</h><w>{width!r}</w><l>{length!r}</l>"
        f"<first_frame>{first}</first_frame><poses><count>{last + 1 - first}</count><item_version>2</item_version>\n"
        f"{poses}</poses><finished>1</finished></item>\n"
    )


def _pose_text(pose: Float64[np.ndarray, "4 4"] | None, height: float, what: str) -> str:
    place, angles, state = np.zeros(3), (0.0, 0.0, 0.0), _UNSET
    if pose is not None:
        place, angles, state = pose[:3, 3] - 0.5 * height * pose[:3, 2], angles_of(pose[:3, :3]), _LABELED
    if np.abs(place).max() > _FARTHEST:
        raise ValueError(
            f"{what} lies {np.abs(place).max():.0f} m from the lidar, and KITTI's readers refuse boxes beyond "
            f"{_FARTHEST:.0f} m: leave the object out, or check the log's scale"
        )
    values = dict(zip(("tx", "ty", "tz", "rx", "ry", "rz"), (*place.tolist(), *angles), strict=True))
    fields = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    return f"<item>{fields}<state>{state}</state><occlusion>-1</occlusion><truncation>-1</truncation></item>\n"


def _tracklet(item: Element, path: Path, what: str) -> Tracklet:
    class_name = (item.findtext("objectType") or "").strip()
    height, width, length, first = _values(item, ("h", "w", "l", "first_frame"), path, what)
    if not class_name or not (0 <= first < 1e6) or first % 1:
        message = f"{what} has the class {class_name!r} and the first frame {first:g}"
        raise fault(path, message, _REMEDY)
    if min(height, width, length) <= 0 or max(height, width, length) > 100:
        raise fault(path, f"{what} is {length:g} m long, {width:g} m wide and {height:g} m high", _REMEDY)
    boxes = item.findall("poses/item")
    keys = ("tx", "ty", "tz", "rx", "ry", "rz", "state")
    rows = np.array([_values(box, keys, path, f"{what}, pose {place}") for place, box in enumerate(boxes)])
    rows = rows.reshape(len(boxes), len(keys))
    if np.abs(rows[:, :3]).max(initial=0) > _FARTHEST:
        raise fault(path, f"{what} lies {np.abs(rows[:, :3]).max():g} m away, farther than a lidar sees", _REMEDY)
    kept = rows[:, 6] != _UNSET
    poses = _poses(rows[kept], height)
    frames = int(first) + np.flatnonzero(kept)
    return Tracklet(class_name, np.array([length, width, height]), frames, poses, int((~kept).sum()))


def _poses(rows: Float64[np.ndarray, "f 7"], height: float) -> Float64[Tensor, "f 4 4"]:
    """From the center of the bottom to that of the box; yaw counts past half a turn, which its sine does not mind."""
    (x_turn, y_turn, yaw) = rows[:, 3:6].T
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = _about(2, yaw) @ _about(1, y_turn) @ _about(0, x_turn)
    poses[:, :3, 3] = rows[:, :3] + 0.5 * height * poses[:, :3, 2]
    return torch.from_numpy(poses)


def _about(axis: int, angles: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, "f 3 3"]:
    """Rotations about x, y or z."""
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turns[:, first, first] = turns[:, second, second] = np.cos(angles)
    turns[:, first, second], turns[:, second, first] = -np.sin(angles), np.sin(angles)
    return turns


def _values(item: Element, keys: tuple[str, ...], path: Path, what: str) -> Float64[np.ndarray, " n"]:
    missing = [key for key in keys if item.find(key) is None]
    if missing:
        raise fault(path, f"{what} lacks {', '.join(missing)}", _REMEDY)
    return numbers([item.findtext(key) or "" for key in keys], path, f"{what} ({', '.join(keys)})")
