"""Where DriveStudio's processed layout keeps what, in each of its flavors."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.drivestudio.flavors import Flavor, FlavorName, flavor_of, named_flavor
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.window import chosen_cameras, frame_window, listed

_FRAME = re.compile(r"(\d+)")
_CAMERA = re.compile(r"(\d+)")
_FRAME_CAMERA = re.compile(r"(\d+)_(\d+)")

SKY_MASKS = "sky_masks"
FINE_MASKS = "fine_dynamic_masks"
"""Holds a folder a kind; so do the coarse ones, which are projected boxes."""
COARSE_MASKS = "dynamic_masks"
EGO_MASKS = "ego_masks"


@dataclass(frozen=True)
class Layout:
    """A log's folder and the part of it that is read: file names of every kind."""

    root: Path
    flavor: Flavor
    frames: Sequence[int]
    """Frames of the window that are read, in the folder's own numbers."""
    cameras: tuple[int, ...]
    front: int
    """Lowest camera number in the folder: the re-centered world starts there, whichever cameras are read."""
    num_frames_on_disk: int
    has_lidar: bool
    """Whether there are sweeps, and they are read."""
    has_bodies: bool
    """Whether there are body poses of people, and they are read."""
    absent: int = 0
    """Frames of the window that were left out, because a file of them is missing."""

    @property
    def images(self) -> Iterator[tuple[int, int]]:
        """(frame, camera) of every image that is read, in the order of the log's frames."""
        return ((frame, camera) for frame in self.frames for camera in self.cameras)

    def image(self, frame: int, camera: int) -> Path:
        return self.root / "images" / f"{frame:03d}_{camera}.jpg"

    def intrinsics(self, camera: int) -> Path:
        return self.root / "intrinsics" / f"{camera}.txt"

    def extrinsics(self, frame: int, camera: int) -> Path:
        """Of a mounted camera: camera -> vehicle, the same at all frames. Of others: camera -> world."""
        return self.root / "extrinsics" / (f"{camera}.txt" if self.flavor.mounted else f"{frame:03d}_{camera}.txt")

    def sweep_pose(self, frame: int) -> Path:
        """Frame of the lidar points -> world: that of the vehicle, if cameras are mounted, else of the sensor."""
        return self.root / self.flavor.sweep_poses / f"{frame:03d}.txt"

    def sweep(self, frame: int) -> Path:
        return self.root / "lidar" / f"{frame:03d}.bin"

    @property
    def instances(self) -> Path:
        return self.root / "instances" / "instances_info.json"

    @property
    def frame_instances(self) -> Path:
        return self.root / "instances" / "frame_instances.json"

    @property
    def has_instances(self) -> bool:
        return self.instances.parent.is_dir()

    @property
    def bodies(self) -> Path:
        return self.root / "humanpose" / "smpl.pkl"

    @property
    def timestamps(self) -> Path:
        """Seconds of each frame, one a line, by any clock."""
        return self.root / "timestamps.txt"

    def image_timestamps(self, camera: int) -> Path:
        """Seconds of each image of a camera, one a line, by the same clock; absent: those of the frames."""
        return self.root / f"timestamps_{camera}.txt"

    @property
    def has_clock(self) -> bool:
        return self.timestamps.exists()

    def ego_mask(self, camera: int) -> Path | None:
        """What the recording car covers of a camera's images, the same at all frames; None where it is not told."""
        path = self.root / EGO_MASKS / f"{camera}.png"
        return path if path.is_file() else None

    def mask_folder(self, kind: str) -> Path | None:
        """Folder of the masks of a kind (sky, human, vehicle), or None where the log has none.

        Fine masks replace the coarse ones as soon as their folder exists, never a class at a time (DriveStudio).
        """
        if kind == "sky":
            folder = self.root / SKY_MASKS
            return folder if folder.is_dir() else None
        coarse, fine = self.root / COARSE_MASKS / kind, self.root / FINE_MASKS
        if fine.is_dir():
            # A class that has coarse masks only counts as missing: mixing the two would change what metrics mean.
            return fine / kind if (fine / kind).is_dir() or coarse.is_dir() else None
        return coarse if coarse.is_dir() else None

    def mask(self, kind: str, frame: int, camera: int) -> Path | None:
        folder = self.mask_folder(kind)
        return None if folder is None else folder / f"{frame:03d}_{camera}.png"


MASK_KINDS = ("sky", "human", "vehicle")


def find_layout(
    root: Path,
    *,
    cameras: Sequence[int] | None = None,
    first_frame: int = 0,
    last_frame: int = -1,
    lidar: bool = True,
    bodies: bool = True,
    flavor: FlavorName | None = None,
) -> Layout:
    """Choose cameras and frames (last_frame is included; -1: to the end); without ``flavor`` the files tell it.

    Without ``lidar`` or ``bodies`` the folder is looked at as if it had none.

    Raises LogError where the folder is no such log, ValueError where cameras or frames are asked for that it lacks.
    """
    if not (root / "images").is_dir():
        raise _no_log(root)
    found = named_flavor(root, flavor) if flavor else flavor_of(root, lidar=lidar)
    images = _numbers(root / "images", ".jpg", _FRAME_CAMERA)
    on_disk = sorted({camera for _, camera in images} | {n for (n,) in _numbers(root / "intrinsics", ".txt", _CAMERA)})
    if not images or not on_disk:
        raise fault(root / "images", "the folder holds no TTT_C.jpg", "write the images as frame_camera, as 000_0.jpg")
    count = _count_frames(root, found, lidar)
    frames = frame_window(count, first_frame, last_frame, root)
    chosen = chosen_cameras(on_disk, cameras, root)
    has_lidar = lidar and (root / "lidar").is_dir()
    has_bodies = bodies and (root / "humanpose").is_dir()
    return Layout(root, found, frames, chosen, on_disk[0], count, has_lidar, has_bodies)


def _no_log(root: Path) -> LogError:
    """What is there instead of a scene, and what to do about it."""
    wanted = "the folder of one scene in DriveStudio's processed layout"
    if not root.is_dir():
        return fault(root, "this is a file" if root.exists() else "nothing is there", f"name {wanted}")
    scenes = sorted(path.parent.name for path in root.glob("*/images"))
    if scenes:
        message = f"the folder has no images/; it holds the scenes {listed(scenes)}"
        return fault(root, message, f"name one: {root / scenes[0]}")
    remedy = f"name {wanted}, or say data=auto, which finds out whose files these are"
    return fault(root, "the folder has no images/", remedy)


def _count_frames(root: Path, flavor: Flavor, lidar: bool) -> int:
    """One more than the highest frame number of any kind of file: where one kind stops early, its files are missing."""
    found = [(frame,) for frame, _ in _numbers(root / "images", ".jpg", _FRAME_CAMERA)]
    if lidar:
        found += _numbers(root / "lidar", ".bin", _FRAME)
    if lidar or flavor.mounted:
        found += _numbers(root / flavor.sweep_poses, ".txt", _FRAME)
    if not flavor.mounted:
        found += [(frame,) for frame, _ in _numbers(root / "extrinsics", ".txt", _FRAME_CAMERA)]
    return 1 + max(frame for (frame,) in found)


def _numbers(folder: Path, suffix: str, pattern: re.Pattern[str]) -> list[tuple[int, ...]]:
    """The numbers in the names of the folder's files that look as they should; others are none of our business."""
    if not folder.is_dir():
        return []
    matches = [pattern.fullmatch(path.stem) for path in folder.iterdir() if path.suffix == suffix]
    return [tuple(int(number) for number in match.groups()) for match in matches if match]
