"""The flavors of DriveStudio's processed layout, one a data set, and how a folder tells which one it has."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sparsestreet.data.numbers import read_numbers
from sparsestreet.data.problems import LogError, fault

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


FLAVORS: dict[str, Flavor] = {
    flavor.name: flavor
    for flavor in (
        Flavor(name="waymo", mounted=True, opencv=False, sweep_poses="ego_pose", columns=14, x_column=3),
        Flavor(name="nuscenes", mounted=False, opencv=True, sweep_poses="lidar_pose", columns=4),
        Flavor(name="kitti", mounted=True, opencv=True, sweep_poses="ego_pose", columns=4),
        Flavor(name="argoverse", mounted=True, opencv=True, sweep_poses="ego_pose", columns=4),
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
