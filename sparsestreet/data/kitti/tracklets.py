"""Annotated objects of a drive from tracklet_labels.xml."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from sparsestreet.data.kitti.text import numbers
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.data.safe_xml import elements

_LARGEST = 1 << 25
"""Bytes; 15 objects of 100 frames take 0.3 MB."""
_UNSET = 0
"""State of a pose that nobody gave."""
_FARTHEST = 1000.0
"""Meters."""
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
