"""Which release of Waymo's Open Dataset a folder holds, and the segment of it that is wanted."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.problems import fault
from sparsestreet.data.waymo.segment import Segment, canonical
from sparsestreet.data.waymo.v1.segment import RecordSegment
from sparsestreet.data.waymo.v2.segment import TableSegment
from sparsestreet.data.window import listed

_COMPONENTS = ("vehicle_pose", "camera_image", "camera_calibration", "lidar", "lidar_box")
_RECORDS = ("*.tfrecord", "*/*.tfrecord", "*/*/*.tfrecord")
_LARGEST_INDEX = 10**6
"""A number above is no place in a list but a name: Hydra takes the digits and underscores of one for a number."""


@dataclass(frozen=True)
class Found:
    """The segments of a folder, by name: files of version 1, folders of components of version 2."""

    version: int
    places: Mapping[str, Path]


def find_segments(root: Path) -> Found:
    """Raises LogError for a folder that holds segments of neither version, or of both."""
    if not root.is_dir():
        raise fault(root, "there is no such folder", "name the folder that holds Waymo's files (data.root)")
    records = {canonical(path.name): path for pattern in _RECORDS for path in sorted(root.glob(pattern))}
    tables = {
        canonical(path.name): path.parent.parent
        for component in _COMPONENTS
        for pattern in (f"{component}/*.parquet", f"*/{component}/*.parquet")
        for path in sorted(root.glob(pattern))
    }
    if records and tables:
        message = f"it holds {len(records)} segments of version 1 (.tfrecord) and {len(tables)} of version 2 (.parquet)"
        raise fault(root, message, "name the folder of one of them (data.root)")
    if not records and not tables:
        message = "it holds neither *.tfrecord (version 1) nor component/*.parquet (version 2), up to two folders deep"
        raise fault(root, message, "name the folder that holds Waymo's files (data.root)")
    return Found(1, records) if records else Found(2, tables)


def find_segment(root: Path, scene: str | int | None, scenes: Path | None) -> Segment:
    """The wanted segment, opened.

    Args:
        root: of the files.
        scene: name of a segment, or its place in ``scenes``, from 0; None: the only one.
        scenes: a file with the name of a segment a line.

    Raises LogError for files at fault, ValueError for a scene that is not there.
    """
    found = find_segments(root)
    name = _wanted(found, scene, scenes, root)
    place = found.places[name]
    return RecordSegment(place) if found.version == 1 else TableSegment(place, name)


def _wanted(found: Found, scene: str | int | None, scenes: Path | None, root: Path) -> str:
    names = sorted(found.places)
    shown = listed(names)
    if scene is None:
        if len(names) > 1:
            raise ValueError(f"data.log.scene must name one of the segments in {root}: {shown}")
        return names[0]
    if isinstance(scene, int) and scene <= _LARGEST_INDEX:
        scene = _at_place(scene, scenes, shown)
    if isinstance(scene, int):
        name = next((name for name in names if name.replace("_", "") == str(scene)), str(scene))
    else:
        name = canonical(scene)
    if name not in found.places:
        raise ValueError(f"segment {name} is not in {root}: data.log.scene must be one of {shown}")
    return name


def _at_place(place: int, scenes: Path | None, shown: str) -> str:
    """The line of a list of names."""
    if scenes is None:
        message = f"data.log.scene={place} is a place in a list of segments: name the list (data.log.scenes)"
        raise ValueError(f"{message}, or one of the segments {shown}")
    try:
        lines = [line for line in scenes.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise fault(scenes, f"the list cannot be read ({error})", "write the name of a segment a line") from error
    if not 0 <= place < len(lines):
        message = f"data.log.scene={place} is not within the {len(lines)} segments of {scenes}, counted from 0"
        raise ValueError(f"{message}; there are files of {shown}")
    return lines[place]
