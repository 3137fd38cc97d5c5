"""Where DriveStudio's processed layout keeps what, in each of its flavors."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.reader import chosen_cameras, frame_window, listed
from sparsestreet.types import MaskSource


def read_numbers(path: Path) -> Float64[np.ndarray, "rows columns"]:
    """The lines of numbers of a text file, empty ones left out; raises LogError where it is missing or no table."""
    if not path.is_file():
        raise fault(path, "the file is missing", "write it, or leave out its frame or camera")
    try:
        rows = [[float(number) for number in line.split()] for line in path.read_text().splitlines() if line.strip()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 0)
    except ValueError as error:
        raise fault(path, f"the file is no table of numbers ({error})", "write numbers separated by spaces") from error


FlavorName = Literal["waymo", "nuscenes", "kitti", "argoverse", "nuplan", "pandaset"]

UPRIGHT = 0.7
"""Least cosine between the vehicle's upward axis and a camera's: cameras are tilted, but never by 45 degrees."""


@dataclass(frozen=True, kw_only=True)
class Flavor:
    """What differs between the data sets."""

    name: str
    mounted: bool
    """True: extrinsics/C.txt is camera -> vehicle, ego_pose/TTT.txt vehicle -> world. False: extrinsics/TTT_C.txt is
    camera -> world."""
    opencv: bool
    """Camera axes. True: x right, y down, z forward (OpenCV). False: x forward, y left, z up (Waymo)."""
    sweep_poses: str
    """Folder of the poses of the frame that lidar points are in."""
    columns: int
    """float32 columns of a lidar row."""
    x_column: int = 0
    """Column of a point's x, before y and z (a Waymo row starts with the ray's origin)."""
    intensity: int | None = None
    """Column of a point's intensity; None: not known."""


FLAVORS: dict[str, Flavor] = {
    flavor.name: flavor
    for flavor in (
        Flavor(name="waymo", mounted=True, opencv=False, sweep_poses="ego_pose", columns=14, x_column=3, intensity=11),
        Flavor(name="nuscenes", mounted=False, opencv=True, sweep_poses="lidar_pose", columns=4, intensity=3),
        Flavor(name="kitti", mounted=True, opencv=True, sweep_poses="ego_pose", columns=4, intensity=3),
        Flavor(name="argoverse", mounted=True, opencv=True, sweep_poses="ego_pose", columns=4, intensity=3),
        Flavor(name="nuplan", mounted=True, opencv=True, sweep_poses="ego_pose", columns=6),
        Flavor(name="pandaset", mounted=False, opencv=True, sweep_poses="ego_pose", columns=5),
    )
}
NAME_IT = f"name the flavor, data.log.flavor={', '.join(FLAVORS)}"
"""The remedy where the files leave it open."""


def flavor_of(root: Path, *, lidar: bool) -> Flavor:
    """The flavor that the files of a folder leave; ``lidar``: whether its sweeps are to be read.

    Poses tell where cameras are mounted, the mounts tell their axes, and the size of the sweeps their columns. KITTI
    and Argoverse are alike in all of this, so either name does; without sweeps, nuPlan is too.

    Raises LogError where the files leave more than one flavor, or none.
    """
    extrinsics = root / "extrinsics"
    mounts = _mounts(extrinsics)
    if any(re.fullmatch(r"\d+_\d+", path.stem) for path in _texts(extrinsics)):
        moving = [flavor for flavor in FLAVORS.values() if not flavor.mounted]
        found = [flavor for flavor in moving if (root / flavor.sweep_poses).is_dir()]
        if len(found) > 1 or (mounts and (root / "ego_pose").is_dir()):
            raise fault(extrinsics, "poses of images stand beside poses of the vehicle", NAME_IT)
        return found[0] if found else FLAVORS["nuscenes"]
    if not (root / "ego_pose").is_dir():
        remedy = "add ego_pose/TTT.txt and extrinsics/C.txt (Waymo flavor) or extrinsics/TTT_C.txt (nuScenes flavor)"
        raise fault(extrinsics, "the folder holds no poses of any flavor", remedy)
    opencv = _opencv_axes(extrinsics, mounts)
    if not opencv:
        return FLAVORS["waymo"]
    return _by_columns(root / "lidar") if lidar and (root / "lidar").is_dir() else FLAVORS["kitti"]


def named_flavor(root: Path, name: FlavorName) -> Flavor:
    """The flavor of a name. Raises LogError where all mounted cameras stand upright by the other axes than its own.

    They would be turned on their sides, and without lidar no file would be of a wrong size.
    """
    flavor, extrinsics = FLAVORS[name], root / "extrinsics"
    told = _axes(_mounts(extrinsics)) if flavor.mounted else set()
    if told == {"waymo" if flavor.opencv else "opencv"}:
        others = [other.name for other in FLAVORS.values() if other.mounted and other.opencv != flavor.opencv]
        message = f"data.log.flavor={name}, but all cameras are upright by the axes of {', '.join(others)}"
        raise fault(extrinsics, message, f"{NAME_IT}, or leave it out")
    return flavor


def _mounts(extrinsics: Path) -> list[Path]:
    """The files of mounted cameras."""
    return sorted(path for path in _texts(extrinsics) if re.fullmatch(r"\d+", path.stem))


def _texts(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix == ".txt"] if folder.is_dir() else []


def _opencv_axes(extrinsics: Path, mounts: Sequence[Path]) -> bool:
    """Whether y of the mounted cameras points down in the vehicle, whose z is up; False: their z points up."""
    found = _axes(mounts)
    if len(found) > 1 or "neither" in found:
        message = "neither y (down, OpenCV) nor z (up, Waymo) of all cameras is upright in the vehicle"
        raise fault(extrinsics, message, NAME_IT)
    return found == {"opencv"}


def _axes(mounts: Sequence[Path]) -> set[str]:
    """Whose axes stand upright in the vehicle: "opencv", "waymo" or "neither", of each camera.

    Files that hold no pose are left to the check of the log, which names them.
    """
    found = set()
    for path in mounts:
        try:
            pose = read_numbers(path)
        except LogError:
            continue
        if pose.shape == (4, 4):
            found.add("opencv" if pose[2, 1] < -UPRIGHT else "waymo" if pose[2, 2] > UPRIGHT else "neither")
    return found


def _by_columns(sweeps: Path) -> Flavor:
    """The flavor of mounted OpenCV cameras into whose rows every sweep can be cut."""
    sizes = [path.stat().st_size for path in sweeps.glob("*.bin")]
    fits = [name for name in ("kitti", "nuplan") if not any(size % (4 * FLAVORS[name].columns) for size in sizes)]
    if len(fits) == 1:
        return FLAVORS[fits[0]]
    many = "both" if fits else "neither"
    message = f"cameras have OpenCV's axes, and the sweeps fit {many} rows of 4 (KITTI, Argoverse) and of 6 (nuPlan)"
    raise fault(sweeps, message, f"{NAME_IT}, or leave the lidar out: data.log.lidar=false")


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

    @property
    def mask_sources(self) -> dict[str, MaskSource]:
        """Kind of ``FOLDER_KINDS`` that the log has -> whose masks they are."""
        moving: MaskSource = "fine" if (self.root / FINE_MASKS).is_dir() else "coarse"
        present = (kind for kind in FOLDER_KINDS if self.mask_folder(kind) is not None)
        return {kind: "shipped" if kind == "sky" else moving for kind in present}

    def mask(self, kind: str, frame: int, camera: int) -> Path | None:
        folder = self.mask_folder(kind)
        return None if folder is None else folder / f"{frame:03d}_{camera}.png"


FOLDER_KINDS = ("sky", "human", "vehicle")
"""Kinds of masks that have a folder, with a file for each image; that of the recording car is apart."""


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
