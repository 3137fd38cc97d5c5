"""What the numbers mean that a segmenter answers with: which of its classes are sky, people and vehicles.

Who rides counts as human, and so do bicycles and motorcycles; trains and trams are no vehicles. So are DriveStudio's
masks, by which results are published. A file of names can say otherwise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

KINDS = ("sky", "human", "vehicle")
"""Kinds of masks that a segmenter can tell; only the log knows what shows the recording car."""
_NAMES = {
    "sky": ("sky", "sky-other-merged"),
    "human": (
        *("human", "person", "people", "pedestrian", "rider", "cyclist", "bicyclist", "motorcyclist"),
        *("bicycle", "motorcycle", "motorbike", "minibike"),
    ),
    "vehicle": ("vehicle", "car", "truck", "bus", "van", "caravan", "trailer"),
}
_COCO_THINGS = {0: "person", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
_TABLES: Mapping[str, tuple[int, Mapping[int, str]]] = {
    "cityscapes": (
        19,
        {10: "sky", 11: "person", 12: "rider", 13: "car", 14: "truck", 15: "bus", 17: "motorcycle", 18: "bicycle"},
    ),
    "ade20k": (
        150,
        {2: "sky", 12: "person", 20: "car", 80: "bus", 83: "truck", 102: "van", 116: "minibike", 127: "bicycle"},
    ),
    "coco": (133, _COCO_THINGS | {119: "sky-other-merged"}),
    "coco80": (80, _COCO_THINGS),
}
"""Number of classes, and those of them that matter, as the models of each data set count them from 0."""


@dataclass(frozen=True)
class SegmentationClasses:
    """The classes of a segmenter, counted from 0."""

    name: str
    """Of the table, or the file."""
    count: int
    kinds: Mapping[str, Mapping[str, Sequence[int]]]
    """Kind of mask -> name of a class -> its numbers; only kinds that some class is of."""

    def numbers(self, kind: str) -> list[int]:
        """Return all classes of a kind."""
        return sorted(number for numbers in self.kinds[kind].values() for number in numbers)

    def __str__(self) -> str:
        return "; ".join(f"{kind}: {', '.join(names)}" for kind, names in self.kinds.items())


def segmentation_classes(words: str) -> SegmentationClasses:
    """Return the classes of a table by its name, or of a file with the name of a class a line, in their order.

    Raises ValueError for what is neither, or has no class of any kind; OSError for a file that cannot be read.
    """
    if words in _TABLES:
        return _sorted(words, *_TABLES[words])
    path = Path(words).expanduser()
    if not path.is_file():
        raise ValueError(f"classes={words} is none of {', '.join(_TABLES)}, and no file: name one of them")
    try:
        names = path.read_text(encoding="utf-8").rstrip().split("\n")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text ({error}): write the name of a class a line") from error
    if "" in (stripped := [name.strip() for name in names]):
        raise ValueError(f"line {stripped.index('') + 1} of {path} is empty: write a name for each class")
    return _sorted(words, len(names), dict(enumerate(stripped)))


def _sorted(name: str, count: int, named: Mapping[int, str]) -> SegmentationClasses:
    kinds: dict[str, dict[str, list[int]]] = {}
    for kind in KINDS:
        for number, called in named.items():
            if called.lower() in _NAMES[kind]:
                kinds.setdefault(kind, {}).setdefault(called, []).append(number)
    if not kinds:
        known = ", ".join(word for words in _NAMES.values() for word in words)
        raise ValueError(f"none of the {count} classes of {name} is of a kind of masks: call those that are {known}")
    return SegmentationClasses(name, count, kinds)
