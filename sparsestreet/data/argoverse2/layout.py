"""Where a log lies, and which of its images belong to which sweep."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sparsestreet.data.problems import fault
from sparsestreet.data.window import chosen_cameras, frame_window, listed

POSES = "city_SE3_egovehicle.feather"
USUAL_CAMERAS = ("ring_front_center", "ring_front_left", "ring_front_right")
EGO_ROWS = {"ring_front_center": (250, 2048), "ring_rear_left": (250, 1550), "ring_rear_right": (250, 1550)}
"""How many of the lowest rows show the recording car, and of how many (NeuRAD crops these)."""
SPIN = 100_000_000
"""Nanoseconds of a turn of the lidars. The stamp of a sweep is the start of it."""
_FOLDERS = (".", "*", "*/*")
"""Of a log, below the root: the root is the log, a split, or the data set."""
_LATEST = 2**63
_REMEDY = "rename it to the nanoseconds at which it was recorded, or remove it"


@dataclass(frozen=True)
class Layout:
    """The files of one log."""

    root: Path

    @property
    def poses(self) -> Path:
        return self.root / POSES

    @property
    def boxes(self) -> Path:
        return self.root / "annotations.feather"

    @property
    def intrinsics(self) -> Path:
        return self.root / "calibration" / "intrinsics.feather"

    @property
    def mounts(self) -> Path:
        return self.root / "calibration" / "egovehicle_SE3_sensor.feather"

    @property
    def sweeps(self) -> Path:
        return self.root / "sensors" / "lidar"

    def images(self, camera: str) -> Path:
        return self.root / "sensors" / "cameras" / camera


def find_log(root: Path, scene: str | int | float | None) -> Layout:
    """The log whose name begins with ``scene``, at the root or at most two folders below.

    Raises ValueError where there is none, or more than one, or for a scene that is no text: 7e128381 is a number.
    """
    found = sorted({path.parent for folder in _FOLDERS for path in root.glob(f"{folder}/{POSES}")})
    if not found:
        raise ValueError(f"no log of Argoverse 2 is in {root}: a log's folder holds {POSES}")
    if isinstance(scene, float):
        names = listed([log.name for log in found])
        raise ValueError(f"data.log.scene is the number {scene}: put the name of the log into quotes, one of {names}")
    scene = None if scene is None else str(scene)
    logs = [log for log in found if scene is None or log.resolve().name.startswith(scene)]
    if len(logs) == 1:
        return Layout(logs[0])
    names = listed([log.name for log in logs or found])
    which = f"{len(logs)} of {len(found)} logs are named {scene}..." if scene else f"there are {len(found)} logs"
    raise ValueError(f"{which} in {root}: say data.log.scene=, the first characters of one of {names}")


def stamped_files(folder: Path, ending: str) -> dict[int, Path]:
    """Files by the nanoseconds that are their names, in order of time; empty where the folder is not there.

    Hidden files are passed over. Raises LogError for a name that is no stamp.
    """
    files = {}
    for path in folder.glob(f"*{ending}"):
        if path.name.startswith("."):
            continue
        stem = path.stem
        if not re.fullmatch("[1-9][0-9]{0,18}", stem) or int(stem) >= _LATEST:
            raise fault(path, "the name is no stamp in nanoseconds", _REMEDY)
        files[int(stem)] = path
    return dict(sorted(files.items()))


@dataclass(frozen=True)
class Selection:
    """The part of a log that is read."""

    layout: Layout
    sweeps: Mapping[int, Path]
    """All of the log's, by stamp."""
    instants: tuple[int, ...]
    """Stamps of the sweeps that are read: those of the window with an image."""
    images: Mapping[str, tuple[int | None, ...]]
    """Of each camera: the stamp of its image at each instant, where it has one."""
    dropped: int
    """Sweeps of the window without an image."""

    def image(self, camera: str, stamp: int) -> Path:
        return self.layout.images(camera) / f"{stamp}.jpg"


def select(layout: Layout, cameras: Sequence[str] | None, first_frame: int, last_frame: int) -> Selection:
    """The sweeps of a window and the image of each camera that belongs to each.

    Raises LogError for a log without sweeps or images, ValueError for cameras or frames that it does not have.
    """
    sweeps = stamped_files(layout.sweeps, ".feather")
    if not sweeps:
        raise fault(layout.sweeps, "there are no sweeps, of which each is an instant", "fetch the lidar of the log too")
    folders = layout.images("*").parent.glob("*")
    found = {path.name: stamped_files(path, ".jpg") for path in sorted(folders) if path.is_dir()}
    found = {name: files for name, files in found.items() if files}
    if not found:
        raise fault(layout.images("*").parent, "there are no images", "fetch those of the cameras that you want")
    names = cameras or [name for name in USUAL_CAMERAS if name in found] or None
    chosen = chosen_cameras(list(found), names, layout.root)
    window = frame_window(len(sweeps), first_frame, last_frame, layout.root)
    stamps = list(sweeps)[window.start : window.stop]
    matched = {name: nearest_images(stamps, list(found[name])) for name in chosen}
    kept = [place for place in range(len(stamps)) if any(one[place] is not None for one in matched.values())]
    if not kept:
        message = f"no image of {', '.join(chosen)} belongs to a sweep from {stamps[0]} to {stamps[-1]}"
        raise fault(layout.images("*").parent, message, "fetch images and sweeps of the same time")
    images = {name: tuple(one[place] for place in kept) for name, one in matched.items()}
    return Selection(layout, sweeps, tuple(stamps[place] for place in kept), images, len(stamps) - len(kept))


def nearest_images(sweeps: Sequence[int], images: Sequence[int]) -> list[int | None]:
    """For each sweep the image of a camera that is nearest to its middle; None where none is within half a turn.

    Cameras take two images a sweep, because each of the two lidars passes a camera once in a turn.
    """
    stamps = np.array(images, dtype=np.int64)
    found: list[int | None] = []
    for sweep in sweeps:
        distances = np.abs(stamps - (sweep + SPIN // 2))
        nearest = int(distances.argmin())
        image = images[nearest] if distances[nearest] <= SPIN // 2 else None
        # Sweeps that lie closer together than a turn would share an image; it belongs to the first.
        found.append(None if image in found else image)
    return found
