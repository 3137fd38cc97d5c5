"""Where KITTI's raw data keep what, and which part of a drive is read."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.problems import fault
from sparsestreet.data.window import chosen_cameras, frame_window, listed

COLOR = ("image_02", "image_03")
GRAY = ("image_00", "image_01")
_NAME = re.compile(r"(\d{4}_\d\d_\d\d)_drive_\d{4}")
_NO_DRIVES = "there are no folders DATE/DATE_drive_NNNN_sync below data.root, which must be the folder of the dates"
_REMEDY = "set data.root and data.log.drive, or unpack the archive there"


@dataclass(frozen=True)
class Drive:
    """The folder of a drive, and the frames and cameras of it that are read. Frame k has files of the name k."""

    folder: Path
    cameras: tuple[str, ...]
    frames: range
    num_on_disk: int

    @property
    def name(self) -> str:
        return self.folder.name.removesuffix("_sync")

    @property
    def lidar(self) -> Path:
        return self.folder / "velodyne_points"

    @property
    def tracklets(self) -> Path:
        return self.folder / "tracklet_labels.xml"

    def image(self, camera: str, frame: int) -> Path:
        return self.folder / camera / "data" / f"{frame:010d}.png"

    def image_stamps(self, camera: str) -> Path:
        return self.folder / camera / "timestamps.txt"

    def oxts(self, frame: int) -> Path:
        return self.folder / "oxts" / "data" / f"{frame:010d}.txt"

    def sweep(self, frame: int) -> Path:
        return self.lidar / "data" / f"{frame:010d}.bin"

    def lidar_stamps(self, which: str = "") -> Path:
        """Of the instants at which the lidar faced forward; ``_start`` and ``_end``: of its turn."""
        return self.lidar / f"timestamps{which}.txt"

    @property
    def first_oxts(self) -> int:
        """The lowest frame of the drive that has a pose: its latitude is the scale of the world, whatever is read."""
        return min(numbered(self.folder / "oxts" / "data", ".txt"), default=0)


def find_drive(
    root: Path, name: str | int | None, cameras: Sequence[str] | None, first_frame: int, last_frame: int
) -> Drive:
    """A drive below the folder of the dates; None: the only one. Raises LogError where it is not there, ValueError for
    a wanted part that it lacks."""
    folder = _folder(root, None if name is None else str(name).removesuffix("_sync"))
    found = [camera for camera in (*GRAY, *COLOR) if (folder / camera / "data").is_dir()]
    usual = [camera for camera in COLOR if camera in found]
    chosen = chosen_cameras(found, usual or found if cameras is None else cameras, root)
    images = set().union(*(numbered(folder / camera / "data", ".png") for camera in chosen))
    if not images:
        raise fault(folder / chosen[0] / "data", "the folder holds no images", "unpack the archive again")
    frames = frame_window(1 + max(images), first_frame, last_frame, folder)
    return Drive(folder, chosen, frames, 1 + max(images))


def _folder(root: Path, name: str | None) -> Path:
    """Of the drive of a name, or of the only one."""
    found = {path.name.removesuffix("_sync"): path for path in sorted(root.glob("*/*_drive_*_sync"))}
    there = f"the drives in {root} are {listed(list(found))}"
    if name is None:
        if len(found) > 1:
            raise ValueError(f"{there}: name one (data.log.drive)")
        if not found:
            raise fault(root, _NO_DRIVES, _REMEDY)
        (name,) = found
    match = _NAME.fullmatch(name)
    if match is None:
        raise ValueError(f"a drive is named as 2011_09_26_drive_0001, got {name!r}; {there}: set data.log.drive")
    folder = root / match[1] / f"{name}_sync"
    if folder.is_dir():
        return folder
    message = f"there is no such drive; {there}" if found else _NO_DRIVES
    if folder.with_name(f"{name}_extract").is_dir():
        message = "only the unsynchronized, distorted recording (_extract) is there: the _sync one is read"
    raise fault(folder, message, _REMEDY)


def numbered(folder: Path, suffix: str) -> set[int]:
    """The numbers in the names of a folder's files that are ten digits and the suffix."""
    if not folder.is_dir():
        return set()
    return {int(path.stem) for path in folder.iterdir() if path.suffix == suffix and re.fullmatch(r"\d{10}", path.stem)}
