"""The content of ``rig.json``: cameras, frames, the lidar, boxes; poses, lenses and stamps as it has them."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.json_tree import JsonValue, read_json
from sparsestreet.data.poses import check_rigid
from sparsestreet.data.problems import fault
from sparsestreet.data.recording import Boxes
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, FTheta, Lens, Mei, Rational
from sparsestreet.types import Side

_MAX_IMAGE = 100_000
_COLUMNS = ("x", "y", "z", "intensity")


@dataclass(frozen=True)
class CameraEntry:
    """One camera."""

    lens: Lens
    size: tuple[int, int]
    """(width, height), pixels."""
    vehicle_from_camera: Float64[Tensor, "4 4"] | None
    """None: each image has its own pose."""
    ego_mask: Path | None
    """White where the recording car is."""
    readout: int
    """Nanoseconds from the first row or column to the last; 0: all are exposed at once."""
    side: Side
    """The side of the image that is read first."""
    exposure: float | None
    """Seconds that a pixel is exposed."""


@dataclass(frozen=True)
class ImageEntry:
    """One image of a frame."""

    where: JsonValue
    """For errors."""
    path: Path
    stamp: int | None
    world_from_camera: Float64[Tensor, "4 4"] | None


@dataclass(frozen=True)
class FrameEntry:
    """One instant."""

    stamp: int | None
    world_from_vehicle: Float64[Tensor, "4 4"] | None
    images: Mapping[str, ImageEntry]
    sweep: Path | None
    sweep_stamp: int | None


@dataclass(frozen=True)
class LidarEntry:
    """How sweeps are written."""

    vehicle_from_lidar: Float64[Tensor, "4 4"] | None
    """None: points are in the world."""
    columns: tuple[str, ...] | None
    """What the numbers of a row are; None: x, y, z and whatever follows, four in a .bin."""
    nearest: float
    """Meters from the lidar below which returns are of the recording car."""


@dataclass(frozen=True)
class RigTable:
    """All of a file."""

    path: Path
    cameras: Mapping[str, CameraEntry]
    lidar: LidarEntry
    frames: Sequence[FrameEntry]
    boxes: Sequence[Boxes] | None
    absent: int = 0
    """Images that were left out, because their files are missing."""

    @property
    def listed(self) -> int:
        """Images of all frames and cameras, with those that were left out."""
        return self.absent + sum(len(frame.images) for frame in self.frames)

    @property
    def has_clock(self) -> bool:
        return self.frames[0].stamp is not None


def read_table(path: Path) -> RigTable:
    """Raise LogError for the first thing that cannot be."""
    top = read_json(path).only("cameras", "lidar", "frames", "boxes", "comment")
    cameras = {name: _camera(name, value) for name, value in top["cameras"].entries()}
    if not cameras:
        raise top["cameras"].fault("is empty", "write at least one camera")
    frames = [_frame(value, cameras) for value in top["frames"].items()]
    if not any(frame.images for frame in frames):
        raise top["frames"].fault("has no image", "write at least one frame with an image")
    stamped = sum(frame.stamp is not None for frame in frames)
    if 0 < stamped < len(frames):
        raise top["frames"].fault(f"has a stamp in {stamped} of {len(frames)}", "write it for all frames, or for none")
    _check_order(top["frames"], frames)
    boxes = top.get("boxes")
    return RigTable(
        path,
        cameras,
        _lidar(top.get("lidar")),
        frames,
        None if boxes is None else [_boxes(value, len(frames)) for value in boxes.items()],
    )


def with_files(table: RigTable) -> RigTable:
    """Return the table without images whose files are missing. Raises LogError where none is there."""
    images = [{n: image for n, image in frame.images.items() if image.path.is_file()} for frame in table.frames]
    if not any(images):
        raise fault(table.path, f"none of its {table.listed} images is there", "write the images")
    absent = table.listed - sum(map(len, images))
    frames = [replace(frame, images=found) for frame, found in zip(table.frames, images, strict=True)]
    return replace(table, frames=frames, absent=absent)


def _camera(name: str, value: JsonValue) -> CameraEntry:
    value.only("width", "height", "lens", "vehicle_from_camera", "ego_mask", "shutter", "exposure")
    if not name or name in (".", "..") or "/" in name or "\\" in name or "\0" in name:
        raise value.fault("is no name of a camera", "name it as a folder may be named")
    mount, mask, exposure = value.get("vehicle_from_camera"), value.get("ego_mask"), value.get("exposure")
    readout, side = read_shutter(value.get("shutter"))
    size = value["width"].whole(1, _MAX_IMAGE), value["height"].whole(1, _MAX_IMAGE)
    return CameraEntry(
        read_lens(value["lens"]),
        size,
        None if mount is None else read_pose(mount),
        None if mask is None else mask.path(),
        readout,
        side,
        None if exposure is None else exposure.number(positive=True),
    )


def _frame(value: JsonValue, cameras: Mapping[str, CameraEntry]) -> FrameEntry:
    value.only("stamp", "world_from_vehicle", "images", "lidar")
    stamp, pose, sweep = value.get("stamp"), value.get("world_from_vehicle"), value.get("lidar")
    images = {}
    for name, image in value["images"].entries() if "images" in value else ():
        if name not in cameras:
            raise image.fault("is of a camera that is not described", f"write one of {', '.join(cameras)}")
        images[name] = _image(image)
    frame = FrameEntry(
        None if stamp is None else read_stamp(stamp),
        None if pose is None else read_pose(pose),
        images,
        *((None, None) if sweep is None else _file(sweep.only("file", "stamp") if "file" in sweep else sweep)),
    )
    for name, image in images.items():
        if image.world_from_camera is None and (pose is None or cameras[name].vehicle_from_camera is None):
            message = "has no pose: neither its own nor the vehicle's and the camera's on it"
            raise image.where.fault(message, "write world_from_camera, or world_from_vehicle and vehicle_from_camera")
        if image.stamp is not None and stamp is None:
            raise image.where.fault("has a stamp, but its frame has none", "write stamps of all frames too")
    return frame


def _image(value: JsonValue) -> ImageEntry:
    path, stamp = _file(value.only("file", "stamp", "world_from_camera") if not isinstance(value.value, str) else value)
    pose = value.get("world_from_camera")
    return ImageEntry(value, path, stamp, None if pose is None else read_pose(pose))


def _file(value: JsonValue) -> tuple[Path, int | None]:
    """A file's name, or an object with it and a stamp."""
    if isinstance(value.value, str):
        return value.path(), None
    stamp = value.get("stamp")
    return value["file"].path(), None if stamp is None else read_stamp(stamp)


def _lidar(value: JsonValue | None) -> LidarEntry:
    if value is None:
        return LidarEntry(None, None, 0.0)
    value.only("vehicle_from_lidar", "columns", "nearest")
    mount, columns, nearest = value.get("vehicle_from_lidar"), value.get("columns"), value.get("nearest")
    names = None if columns is None else tuple(item.text() for item in columns.items())
    if names is not None and columns is not None and (not {"x", "y", "z"} <= set(names) or len(names) > 64):
        raise columns.fault("does not name x, y, z", f"write the row's numbers, such as {', '.join(_COLUMNS)}")
    if names is not None and columns is not None and len(set(names)) < len(names):
        raise columns.fault("names a column twice", "write one name for each number of a row")
    return LidarEntry(None if mount is None else read_pose(mount), names, 0.0 if nearest is None else nearest.number())


def _boxes(value: JsonValue, num_frames: int) -> Boxes:
    """One object. Its size may change."""
    value.only("name", "class", "size", "at")
    places = value["at"].items()
    frames, stamps, poses, sizes = [], [], [], []
    for place in places:
        place.only("frame", "stamp", "world_from_box", "size")
        frames.append(place["frame"].whole(0, num_frames - 1))
        poses.append(read_pose(place["world_from_box"]).numpy())
        sizes.append((place if "size" in place else value)["size"].numbers(3))
        stamp = place.get("stamp")
        stamps.append(None if stamp is None else read_stamp(stamp))
    if not places or (np.diff(frames) <= 0).any():
        raise value["at"].fault("must name at least one frame, in order, each once", "sort them by frame")
    own = tuple(stamp for stamp in stamps if stamp is not None)
    if own and len(own) < len(stamps):
        raise value["at"].fault(f"has a stamp in {len(own)} of {len(stamps)}", "write it for all, or for none")
    return Boxes(
        value["name"].text(),
        value["class"].text(),
        np.array(frames),
        np.stack(poses),
        np.array(sizes, dtype=np.float64),
        value.file,
        own or None,
    )


def _check_order(where: JsonValue, frames: Sequence[FrameEntry]) -> None:
    stamps = [frame.stamp for frame in frames if frame.stamp is not None]
    for index in range(1, len(stamps)):
        if stamps[index] <= stamps[index - 1]:
            message = f"stamps must increase, but {stamps[index]} follows {stamps[index - 1]}"
            raise where.items()[index]["stamp"].fault(f"is out of order: {message}", "sort the frames by their stamps")


_LATEST = 2**62
_LONGEST_READOUT = 0.5
LENSES: dict[str, type[Lens]] = {
    "pinhole": BrownConrady,
    "opencv": BrownConrady,
    "rational": Rational,
    "fisheye": Fisheye,
    "mei": Mei,
    "f_theta": FTheta,
}
"""Their numbers have the names of the classes' fields."""
_CENTERS = ("cx", "cy", "u0", "v0")
_LISTS = {"polynomial": None, "linear": 3}
"""Numbers that are lists, and of how many; None: of any."""


def read_pose(value: JsonValue) -> Float64[Tensor, "4 4"]:
    """A 4x4 matrix, or a translation and a rotation: a quaternion wxyz. Raises LogError for what is not rigid."""
    if isinstance(value.value, list):
        pose = value.matrix(4, 4)
    else:
        value.only("translation", "rotation")
        rotation = torch.tensor(value["rotation"].numbers(4), dtype=torch.float64)
        if not 0.99 < float(rotation.norm()) < 1.01:
            message = f"is no unit quaternion, its length is {float(rotation.norm()):.3g}"
            raise value["rotation"].fault(message, "write w, x, y, z of a rotation")
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = quat.to_matrix(rotation / rotation.norm())
        pose[:3, 3] = torch.tensor(value["translation"].numbers(3), dtype=torch.float64)
    check_rigid(pose, value.file, value.where)
    return pose


def read_stamp(value: JsonValue) -> int:
    """Nanoseconds, whole: a decimal second would be rounded."""
    return value.whole(-_LATEST, _LATEST)


def read_shutter(value: JsonValue | None) -> tuple[int, Side]:
    """How long a readout takes, nanoseconds, and on which side it starts; None: all pixels are exposed at once."""
    if value is None:
        return 0, "top"
    seconds = value.only("readout", "first")["readout"].number(positive=True)
    if seconds > _LONGEST_READOUT:
        message = f"is {seconds:g} s, longer than any readout"
        raise value["readout"].fault(message, "write seconds from the first row or column to the last")
    side = value["first"]
    for known in get_args(Side):
        if side.text() == known:
            return round(1e9 * seconds), known
    raise side.fault(f"is {side.text()[:40]!r}, no side of an image", f"write one of {', '.join(get_args(Side))}")


def read_lens(value: JsonValue) -> Lens:
    """The model and its numbers. ``first_pixel`` is where the calibration has the center of the first pixel: 0.5, or 0
    as OpenCV's programs have it. Raises LogError for a model that is not known, and numbers that are no lens."""
    model = value["model"]
    if model.text() not in LENSES:
        raise model.fault(f"is {model.text()[:40]!r}, a lens that is not known", f"write one of {', '.join(LENSES)}")
    kind = LENSES[model.text()]
    # A pinhole has no other numbers.
    entries = [entry for entry in fields(kind) if model.value != "pinhole" or entry.default is MISSING]
    value.only("model", "first_pixel", *(entry.name for entry in entries))
    first = value.get("first_pixel")
    shift = 0.0 if first is None else 0.5 - first.number()
    if shift not in (0.0, 0.5):
        raise value["first_pixel"].fault("is where the first pixel's center lies, 0 or 0.5", "write one of them")
    numbers = {}
    for entry in entries:
        if entry.default is MISSING or entry.name in value:
            number = value[entry.name]
            if entry.name in _LISTS:
                numbers[entry.name] = number.numbers(_LISTS[entry.name])
            else:
                numbers[entry.name] = number.number() + (shift if entry.name in _CENTERS else 0.0)
    try:
        return kind(**numbers)
    except ValueError as error:
        raise value.fault(f"is no lens: {error}", "write the calibration again") from error
