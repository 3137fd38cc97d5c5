"""Annotated objects: boxes at the samples, in nuScenes' world."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.nuscenes.scene import LIDAR, SceneFiles, pose_of
from sparsestreet.data.nuscenes.tables import Row, all_rows, rows_of_tokens
from sparsestreet.data.recording import Boxes

_LENGTH_WIDTH_HEIGHT = [1, 0, 2]
"""Places in nuScenes' width, length, height."""


def read_boxes(
    scene: SceneFiles, annotations: Sequence[Row], of_samples: Mapping[int, int]
) -> tuple[list[Boxes], tuple[str, ...]]:
    """Every object of the scene that some return hit, with all its boxes; and what should be known of the others.

    A box without returns is one that annotators placed between boxes with returns: the object is hidden there, not
    gone. An object without any return is a guess, and left out. Without lidar nobody can tell, and all are kept.

    Args:
        scene: whose samples the boxes are of.
        annotations: of the scene.
        of_samples: place of a sample -> the frame that its boxes belong to; boxes of other samples are left out.
    """
    objects: dict[str, list[Row]] = {}
    for row in annotations:
        objects.setdefault(row.text("instance_token"), []).append(row)
    without_lidar = LIDAR not in scene.files
    seen = {token: rows for token, rows in objects.items() if without_lidar or any(map(_returns, rows))}
    classes = _classes(scene, seen)
    boxes = [_boxes(scene, token, classes[token], rows, of_samples) for token, rows in seen.items()]
    return boxes, tuple(_notes(scene, seen, len(objects) - len(seen)))


def _returns(row: Row) -> int:
    """Lidar and radar returns in a box."""
    return row.count("num_lidar_pts") + row.count("num_radar_pts")


def _classes(scene: SceneFiles, objects: Mapping[str, object]) -> dict[str, str]:
    """Instance -> the name of its category."""
    instances = rows_of_tokens(scene.tables / "instance.json", set(objects))
    tokens = {row.text("category_token") for row in instances.values()}
    categories = rows_of_tokens(scene.tables / "category.json", tokens)
    return {token: categories[row.text("category_token")].text("name") for token, row in instances.items()}


def _boxes(scene: SceneFiles, token: str, category: str, rows: Sequence[Row], of_samples: Mapping[int, int]) -> Boxes:
    by_sample: dict[int, Row] = {}
    for row in rows:
        place = scene.places[row.text("sample_token")]
        if by_sample.setdefault(place, row) is not row:
            raise row.fault("instance_token", "must have one box a sample", token)
    places = [place for place in sorted(by_sample) if place in of_samples]
    sizes = np.array([_size(by_sample[place]) for place in places]).reshape(-1, 3)
    poses = [pose_of(by_sample[place]).numpy() for place in places]
    return Boxes(
        name=token,
        class_name=category,
        frames=np.array([of_samples[place] for place in places], np.int64),
        poses=np.array(poses).reshape(-1, 4, 4),
        sizes=sizes,
        path=scene.tables / "sample_annotation.json",
        stamps=tuple(scene.sample_stamps[place] for place in places),
    )


def _size(row: Row) -> Float64[np.ndarray, "3"]:
    """Length, width, height, meters."""
    size = row.numbers("size", (3,))
    if not (size > 0).all():
        raise row.fault("size", "must be a positive width, length and height", size.tolist())
    return size[_LENGTH_WIDTH_HEIGHT]


def _notes(scene: SceneFiles, objects: Mapping[str, Sequence[Row]], unseen: int) -> list[str]:
    rows = [row for boxes in objects.values() for row in boxes]
    notes = []
    if unseen:
        notes.append(f"{unseen} objects that no lidar or radar return hit at any keyframe are left out")
    if LIDAR in scene.files and (hidden := sum(not _returns(row) for row in rows)):
        notes.append(f"{hidden} of {len(rows)} boxes hold no return: their objects are hidden then, and are kept")
    names = {row.token: row.text("name") for row in all_rows(scene.tables / "attribute.json")}
    counts = Counter(names.get(token, "?") for row in rows for token in _attributes(row))
    if counts:
        said = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
        notes.append(f"attributes of the boxes are not used, displacement tells what moves: {said}")
    return notes


def _attributes(row: Row) -> list[str]:
    tokens = row.values.get("attribute_tokens")
    if not isinstance(tokens, list) or not all(isinstance(token, str) for token in tokens):
        raise row.fault("attribute_tokens", "must be a list of tokens", tokens)
    return tokens
