"""Annotated objects from the instances JSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from sparsestreet.data.drivestudio.layout import Layout
from sparsestreet.data.json_tree import unique
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.data.tracks import checked_track
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


def _read_track(key: str, entry: Any, layout: Layout) -> Track:
    path, name = layout.instances, f"object {key}"
    try:
        class_name = str(entry["class_name"])
        columns = [np.array(entry["frame_annotations"][column], dtype=np.float64) for column in _COLUMNS]
    except (KeyError, TypeError, ValueError) as error:
        remedy = f"give it class_name and frame_annotations with the lists {', '.join(_COLUMNS)}"
        raise fault(path, f"{name} cannot be read ({error!r})", remedy) from error
    frames, poses, sizes = columns
    return checked_track(key, class_name, frames, poses, sizes, path=path, num_frames=layout.num_frames_on_disk)


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
        content = json.loads(path.read_text(), object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise fault(path, f"the file is no JSON ({error})", "write it again from the annotations") from error
    if not isinstance(content, dict):
        raise fault(path, f"the file holds a {type(content).__name__}, not an object", "key it by instance or frame")
    return content
