"""Files of a KITTI-360 drive: layout, fisheye calibration, poses and boxes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from sparsestreet.data.kitti.files import (
    RectifiedCamera,
    elements,
    image_sides,
    keyed_numbers,
    numbers,
    read_keyed,
    read_lines,
    rectified_camera,
    rectifying_rotation,
    rigid,
)
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.data.reader import chosen_cameras, listed
from sparsestreet.data.recording import Boxes
from sparsestreet.data.rig import check_lens_camera
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import Mei

RECTIFIED = ("image_00", "image_01")
FISHEYE = ("image_02", "image_03")


@dataclass(frozen=True)
class SequenceFolders:
    """The folders of a sequence below the data set's root. Frame k has files of the name k."""

    root: Path
    name: str
    """Such as 2013_05_28_drive_0000_sync."""
    cameras: tuple[str, ...]

    @property
    def poses(self) -> Path:
        return self.root / "data_poses" / self.name / "poses.txt"

    @property
    def calibration(self) -> Path:
        return self.root / "calibration"

    @property
    def lidar(self) -> Path:
        return self.root / "data_3d_raw" / self.name / "velodyne_points" / "data"

    @property
    def boxes(self) -> Path | None:
        """Those of the whole sequence (train_full) only where there are no others: sequence 0004."""
        paths = [self.root / "data_3d_bboxes" / part / f"{self.name}.xml" for part in ("train", "train_full")]
        return next((path for path in paths if path.is_file()), None)

    def image(self, camera: str, frame: int) -> Path:
        return images_of(self._images(camera)) / f"{frame:010d}.png"

    def stamps(self, camera: str) -> Path:
        return self._images(camera) / "timestamps.txt"

    def sweep(self, frame: int) -> Path:
        return self.lidar / f"{frame:010d}.bin"

    def semantics(self, camera: str) -> Path:
        return self.root / "data_2d_semantics" / "train" / self.name / camera / "semantic"

    def _images(self, camera: str) -> Path:
        return self.root / "data_2d_raw" / self.name / camera


def find_sequence(root: Path, sequence: int | str | None, cameras: Sequence[str] | None) -> SequenceFolders:
    """None: the only one. Raises LogError where the sequence is not there, ValueError for a name or cameras that cannot
    be."""
    name = _name(root, sequence)
    images = root / "data_2d_raw" / name
    on_disk = [camera for camera in (*RECTIFIED, *FISHEYE) if images_of(images / camera).is_dir()]
    usual = [camera for camera in RECTIFIED if camera in on_disk]
    if not on_disk or not (usual or cameras):
        message = "it holds neither image_00/data_rect nor image_01/data_rect"
        raise fault(images, message, "unpack the perspective images")
    return SequenceFolders(root, name, chosen_cameras(on_disk, usual if cameras is None else cameras, root))


def _name(root: Path, sequence: int | str | None) -> str:
    """Of the folders of a sequence, or of the only one."""
    found = sorted(path.name[-9:-5] for path in root.glob("data_2d_raw/2013_05_28_drive_????_sync"))
    there = f"there are sequences {listed(found)}" if found else "root must be the folder of data_2d_raw"
    if sequence is None:
        if not found:
            raise fault(root / "data_2d_raw", f"there is no sequence; {there}", "set data.root")
        if len(found) > 1:
            raise ValueError(f"{there} in {root}: name one (data.log.sequence)")
        (sequence,) = found
    number = str(sequence).removeprefix("2013_05_28_drive_").removesuffix("_sync")
    if not (number.isascii() and number.isdigit() and len(number) <= 4):
        message = f"a sequence of KITTI-360 is a number from 0 to 18, got {sequence!r}; {there}: set data.log.sequence"
        raise ValueError(message)
    name = f"2013_05_28_drive_{int(number):04d}_sync"
    if not (root / "data_2d_raw" / name).is_dir():
        message = f"the sequence is not there; {there}"
        raise fault(root / "data_2d_raw" / name, message, "set data.root and data.log.sequence")
    return name


def images_of(camera: Path) -> Path:
    """The folder of a camera's images: rectified ones, or as the fisheye recorded them."""
    return camera / ("data_rgb" if camera.name in FISHEYE else "data_rect")


_REMEDY = "copy it again from the published archive"
_SHAPE = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2")


@dataclass(frozen=True)
class FisheyeCamera:
    lens: Mei
    """Pixel centers at +0.5; the file counts from the center of the first pixel."""
    size: tuple[int, int]
    """(width, height)."""


def read_fisheye(path: Path) -> FisheyeCamera:
    """From OpenCV's YAML, whose names are unique and which has no space behind its colons; raises LogError."""
    table = read_keyed(path)
    kind = table.get("model_type", "MEI").strip("\"'")
    if kind.upper() != "MEI":
        raise fault(path, f"model_type is {kind!r}, the lens that is read is MEI", _REMEDY)
    names = (*_SHAPE, "u0", "v0", "image_width", "image_height")
    values = {name: float(keyed_numbers(table, name, (1,), path)[0]) for name in names}
    size = image_sides(values["image_width"], values["image_height"], path, "the image")
    try:
        lens = Mei(u0=values["u0"] + 0.5, v0=values["v0"] + 0.5, **{name: values[name] for name in _SHAPE})
    except ValueError as error:
        raise fault(path, str(error), _REMEDY) from error
    check_lens_camera(path, lens, size)
    return FisheyeCamera(lens, size)


@dataclass(frozen=True)
class Calibration360:
    imu_from_lidar: Float64[Tensor, "4 4"]
    """The IMU has x forward, y right, z down; the lidar x forward, y left, z up."""
    imu_from_camera: Mapping[str, Float64[Tensor, "4 4"]]
    """After rectification."""
    cameras: Mapping[str, RectifiedCamera | FisheyeCamera]


def read_poses(path: Path) -> dict[int, Float64[Tensor, "4 4"]]:
    """Frame -> world_from_imu; raises LogError for lines that are no frame with a 3x4 matrix, or out of order.

    Whether the matrices are rigid is asked of those that are used.
    """
    poses: dict[int, Float64[Tensor, "4 4"]] = {}
    last = -1
    for line_number, line in enumerate(read_lines(path), 1):
        if not line:
            continue
        row = numbers(line.split(), path, f"line {line_number}")
        if len(row) != 13:
            raise fault(path, f"line {line_number} has {len(row)} numbers, not a frame and a 3x4 matrix", _REMEDY)
        if row[0] % 1 or not last < row[0] < 1e9:
            message = f"line {line_number} is of frame {row[0]:g}, which does not follow frame {last}"
            raise fault(path, message, _REMEDY)
        last = int(row[0])
        poses[last] = torch.eye(4, dtype=torch.float64)
        poses[last][:3] = torch.from_numpy(row[1:].reshape(3, 4))
    if not poses:
        raise fault(path, "the file holds no poses", _REMEDY)
    return poses


def read_calibration(folder: Path, cameras: Sequence[str]) -> Calibration360:
    """Raise LogError with all that is wrong in the files.

    imu_from_camera = cam_to_pose R_rect^-1: the files place the cameras as they are before rectification. Fisheyes stay
    as they are.
    """
    problems: list[Problem] = []
    places, lidar = folder / "calib_cam_to_pose.txt", folder / "calib_cam_to_velo.txt"
    mounts = attempt(problems, lambda: read_keyed(places)) or {}
    found: dict[str, RectifiedCamera | FisheyeCamera] = {}
    imu_from_camera = {}
    for name in cameras if mounts else ():
        camera = attempt(problems, partial(_camera, folder, name))
        mount = attempt(problems, partial(_mount, mounts, name, places))
        if camera is not None and mount is not None:
            found[name], turn = camera
            imu_from_camera[name] = mount @ inverse(turn)
    lidar_from_first = attempt(problems, partial(_single, lidar))
    first = attempt(problems, partial(_mount, mounts, "image_00", places)) if mounts else None
    if problems or lidar_from_first is None or first is None:
        raise LogError(list(dict.fromkeys(problems)))
    return Calibration360(first @ inverse(lidar_from_first), imu_from_camera, found)


def _camera(folder: Path, name: str) -> tuple[RectifiedCamera | FisheyeCamera, Float64[Tensor, "4 4"]]:
    """A camera and the rotation that rectified it."""
    if name in FISHEYE:
        return read_fisheye(folder / f"{name}.yaml"), torch.eye(4, dtype=torch.float64)
    path = folder / "perspective.txt"
    table = read_keyed(path)
    return rectified_camera(table, name[-2:], path), rectifying_rotation(table, name[-2:], path)


def _mount(table: Mapping[str, str], name: str, path: Path) -> Float64[Tensor, "4 4"]:
    matrix = keyed_numbers(table, name, (3, 4), path)
    return rigid(matrix[:, :3], matrix[:, 3], path, name)


def _single(path: Path) -> Float64[Tensor, "4 4"]:
    """A file of one 3x4 matrix, without a key."""
    found = numbers(" ".join(read_lines(path)).split(), path, "the file")
    if found.shape != (12,):
        raise fault(path, f"the file has {len(found)} numbers, not the 12 of a 3x4 matrix", _REMEDY)
    matrix: np.ndarray = found.reshape(3, 4)
    return rigid(matrix[:, :3], matrix[:, 3], path, "the matrix")


CLASSES = {
    13: "car",
    14: "truck",
    15: "trailer",
    16: "caravan",
    17: "motorcycle",
    18: "bicycle",
    19: "person",
    20: "rider",
    33: "train",
    34: "bus",
    36: "unknown vehicle",
}
"""The XML counts classes otherwise than the label images do (kitti360Scripts, labels.py: kittiId). Buildings, poles and
whatever else cannot move are passed over."""
_STATIC = -1
_SEEN = 150.0
"""Meters from the car within which a box that stands still is read. A sequence has thousands over kilometers."""
_AROUND = 300
"""Frames before and after those of its part of the street: the car sees it from afar, but a sequence that comes back
minutes later may find it gone."""
_LARGEST = 1 << 31
"""Bytes; read piece by piece."""
_SHEAR = 1e-3
"""Of the longest side: float32 matrices show 1e-6."""
_REMEDY_BOXES = "copy it again from the published archive, or remove it to read the sequence without boxes"


@dataclass(frozen=True)
class _Object:
    class_name: str
    window: tuple[int, int]
    """Frames of the 200 m of street in which it was annotated."""
    poses: dict[int, Float64[np.ndarray, "4 4"]] = field(default_factory=dict)
    """By frame; -1: it stands still."""
    sizes: dict[int, Float64[np.ndarray, "3"]] = field(default_factory=dict)


def read_boxes(path: Path, frames: Int[np.ndarray, " f"], positions: Float64[np.ndarray, "f 3"]) -> list[Boxes]:
    """The objects at the frames, which are counted by their place; raises LogError with all at fault.

    A moving object has its boxes at frames of its own. One that stands still has its box at all frames that are near.

    Args:
        path: of the XML.
        frames: that are read, increasing.
        positions: of the car at them, in the world.
    """
    objects: dict[str, _Object] = {}
    problems: list[Problem] = []
    for number, item in enumerate(elements(path, 1, max_bytes=_LARGEST, remedy=_REMEDY_BOXES)):
        if item.find("transform") is None:
            continue
        try:
            _add(objects, item, path, f"{item.tag} (element {number})")
        except LogError as error:
            problems += error.problems
    if problems:
        raise LogError(problems)
    found = (_boxes(name, one, frames, positions, path) for name, one in objects.items())
    return [boxes for boxes in found if boxes is not None]


def _add(objects: dict[str, _Object], item: Element, path: Path, what: str) -> None:
    keys = ("semanticId", "instanceId", "timestamp", "start_frame", "end_frame")
    values = numbers([(item.findtext(key) or "").strip() for key in keys], path, f"{what}, {', '.join(keys)}")
    if (values % 1).any() or np.abs(values).max() > 1e9:
        raise fault(path, f"{what} has {', '.join(keys)} = {values.tolist()}, which are no integers", _REMEDY_BOXES)
    semantic, instance, stamp, start, end = map(int, values)
    if semantic not in CLASSES:
        return
    pose, size = _decomposed(_matrix(item, path, what), path, what)
    name = f"{CLASSES[semantic]}-{instance}"
    found = objects.setdefault(name, _Object(CLASSES[semantic], (start, end)))
    found = objects[name] = replace(found, window=(min(start, found.window[0]), max(end, found.window[1])))
    found.poses[stamp], found.sizes[stamp] = pose, size


def _matrix(item: Element, path: Path, what: str) -> Float64[np.ndarray, "4 4"]:
    """OpenCV's way to write a matrix."""
    found = numbers((item.findtext("transform/data") or "").split(), path, f"{what}, transform")
    if found.shape != (16,) or not np.array_equal(found[12:], [0, 0, 0, 1]):
        raise fault(path, f"{what} has no 4x4 transform with the last row 0 0 0 1", _REMEDY_BOXES)
    return found.reshape(4, 4)


def _decomposed(
    matrix: Float64[np.ndarray, "4 4"], path: Path, what: str
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "3"]]:
    """world_from_object, and length, width, height: the matrix scales a unit cube, then turns and moves it."""
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    stretch = right.T @ np.diag(scales) @ right
    size = stretch.diagonal()
    sheared = np.abs(stretch - np.diag(size)).max() > _SHEAR * scales[0]
    if np.linalg.det(matrix[:3, :3]) <= 0 or sheared or scales[-1] < 1e-3 or scales[0] > 200:
        message = f"{what} has a transform that is no rotation of a box: it scales by {size.round(3).tolist()}"
        raise fault(path, message, _REMEDY_BOXES)
    pose = matrix.copy()
    pose[:3, :3] = left @ right
    return pose, size


def _boxes(
    name: str, one: _Object, frames: Int[np.ndarray, " f"], positions: Float64[np.ndarray, "f 3"], path: Path
) -> Boxes | None:
    if one.poses.keys() == {_STATIC}:
        start, end = one.window
        near = np.linalg.norm(positions - one.poses[_STATIC][:3, 3], axis=1) <= _SEEN
        places = np.flatnonzero(near & (frames >= start - _AROUND) & (frames <= end + _AROUND))
        sources = [_STATIC] * len(places)
    else:
        places = np.flatnonzero(np.isin(frames, [stamp for stamp in one.poses if stamp != _STATIC]))
        sources = frames[places].tolist()
    if not sources:
        return None
    poses = np.stack([one.poses[source] for source in sources])
    return Boxes(name, one.class_name, places, poses, np.stack([one.sizes[source] for source in sources]), path)
