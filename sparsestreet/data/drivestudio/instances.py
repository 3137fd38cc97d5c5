"""Annotated objects from the instances JSON."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.drivestudio.poses import check_rigid
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.types import Track

_COLUMNS = ("frame_idx", "obj_to_world", "box_size")


def read_instances(layout: Layout) -> list[Track]:
    """All annotated objects in the data set's world, with the folder's own frame numbers, named by their JSON key.

    The boxes of instances_info.json count; frame_instances.json repeats them and may leave out frames without boxes.
    Raises LogError with every object at fault.
    """
    entries = _read_json(layout.instances)
    tracks, problems = [], []
    for key, entry in entries.items():
        try:
            tracks.append(_read_track(key, entry, layout))
        except LogError as error:
            problems.extend(error.problems)
    if layout.frame_instances.is_file():
        problems.extend(_unknown_instances(layout, set(entries)))
    if problems:
        raise LogError(problems)
    return tracks


def window(track: Track, frames: range, origin: Float64[Tensor, "3"]) -> Track | None:
    """The track inside the window, frames counted from its start, in the re-centered world; None where it is absent.

    The size stays the mean over all of the log: an object does not change with the window.
    """
    inside = (track.frames >= frames.start) & (track.frames < frames.stop)
    if not inside.any():
        return None
    poses = track.world_from_object[inside].clone()
    poses[:, :3, 3] -= origin
    body = None
    if track.body is not None:
        body = replace(track.body, rotations=track.body.rotations[inside], valid=track.body.valid[inside])
    return replace(track, frames=track.frames[inside] - frames.start, world_from_object=poses, body=body)


def _read_track(key: str, entry: Any, layout: Layout) -> Track:
    path, name = layout.instances, f"object {key}"
    try:
        class_name = str(entry["class_name"])
        columns = [np.array(entry["frame_annotations"][column], dtype=np.float64) for column in _COLUMNS]
    except (KeyError, TypeError, ValueError) as error:
        remedy = f"give it class_name and frame_annotations with the lists {', '.join(_COLUMNS)}"
        raise fault(path, f"{name} cannot be read ({error!r})", remedy) from error
    frames, poses, sizes = columns
    count = len(frames)
    if count == 0:
        raise fault(
            path, f"{name} ({class_name}) has no frames", "remove it, or write the frames that its boxes are from"
        )
    if poses.shape != (count, 4, 4) or sizes.shape != (count, 3):
        message = f"{name} has {count} frames, but poses {poses.shape} and sizes {sizes.shape}"
        raise fault(
            path, message, f"write a 4x4 pose and three lengths for each frame: ({count}, 4, 4) and ({count}, 3)"
        )
    _check_frames(frames, path, name, layout.num_frames_on_disk)
    if not (sizes > 0).all() or not np.isfinite(sizes).all():
        message = f"{name} has a box of {sizes.min(axis=0).round(3).tolist()} m (smallest length, width, height)"
        raise fault(path, message, "write positive lengths in meters, or drop the box")
    for frame, pose in zip(frames.astype(int), torch.from_numpy(poses), strict=True):
        check_rigid(pose, path, f"the pose of {name} at frame {frame}")
    size = torch.from_numpy(sizes).mean(0).float()
    return Track(key, class_name, torch.from_numpy(frames.astype(np.int64)), torch.from_numpy(poses), size)


def _check_frames(frames: np.ndarray, path: Path, name: str, num_frames: int) -> None:
    if frames.ndim != 1 or not (frames % 1 == 0).all() or not (np.diff(frames) > 0).all():
        message = f"{name} has frame_idx {frames.tolist()[:5]} ..., not strictly increasing integers"
        raise fault(path, message, "sort its boxes by frame and keep one a frame")
    if frames[0] < 0 or frames[-1] >= num_frames:
        message = f"{name} has boxes at frames {frames[0]:g} to {frames[-1]:g}, the log ends at {num_frames - 1}"
        raise fault(path, message, "number frames from 0 as the images are, or drop the boxes behind the end")


def _unknown_instances(layout: Layout, known: set[str]) -> list[Problem]:
    """Objects that frame_instances.json lists and instances_info.json does not describe."""
    listed = {str(key) for keys in _read_json(layout.frame_instances).values() for key in keys}
    unknown = sorted(listed - known)
    if not unknown:
        return []
    message = f"it lists objects {unknown[:5]} that {layout.instances.name} does not describe"
    return [Problem(layout.frame_instances, message, "write both files from the same annotations")]


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or remove the folder to read the log without boxes")
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise fault(path, f"the file is no JSON ({error})", "write it again from the annotations") from error
    if not isinstance(content, dict):
        raise fault(path, f"the file holds a {type(content).__name__}, not an object", "key it by instance or frame")
    return content
