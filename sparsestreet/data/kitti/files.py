"""Files of a KITTI drive, several of which KITTI-360 shares: layout, stamps, calibration and sweeps."""

import calendar
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import torch
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import iterparse
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.lidar import sensor_returns
from sparsestreet.data.poses import check_rigid
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.data.reader import chosen_cameras, frame_window, listed
from sparsestreet.geometry.cameras import inverse

_MAX_TEXT_BYTES = 1 << 26
"""Bytes; the longest sequence of KITTI-360 has stamps and poses of 3 MB."""
_STAMP = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?")
_REMEDY = "copy it again from the published archive"


def read_lines(path: Path, largest: int = _MAX_TEXT_BYTES) -> list[str]:
    """Stripped lines, empty ones among them; raises LogError where the file is missing, too large or no text."""
    try:
        if path.stat().st_size > largest:
            message = f"the file has {path.stat().st_size} bytes, more than the {largest} that such a file can have"
            raise fault(path, message, _REMEDY)
        check_regular(path)
        return [line.strip() for line in path.read_text("utf-8").splitlines()]
    except FileNotFoundError as error:
        raise fault(path, "the file is missing", _REMEDY) from error
    except (OSError, UnicodeDecodeError) as error:
        raise fault(path, f"the file cannot be read ({error})", _REMEDY) from error


def numbers(words: Sequence[str], path: Path, what: str) -> Float64[np.ndarray, " n"]:
    """Finite numbers; raises LogError for anything else."""
    try:
        found = np.array([float(word) for word in words], dtype=np.float64)
    except ValueError as error:
        raise fault(path, f"{what} holds what is no number ({error})", _REMEDY) from error
    if not np.isfinite(found).all():
        raise fault(path, f"{what} holds NaN or infinity", _REMEDY)
    return found


def read_keyed(path: Path) -> dict[str, str]:
    """Lines ``key: value``; raises as ``read_lines``."""
    lines = (line.partition(":") for line in read_lines(path))
    return {key.strip(): value.strip() for key, colon, value in lines if colon}


def keyed_numbers(table: Mapping[str, str], key: str, shape: tuple[int, ...], path: Path) -> Float64[np.ndarray, "..."]:
    """The numbers of a key; raises LogError where it is missing or holds another number of them."""
    if key not in table:
        raise fault(path, f"it has no line {key!r}", _REMEDY)
    found = numbers(table[key].split(), path, f"the line {key!r}")
    if found.size != np.prod(shape):
        message = f"the line {key!r} has {found.size} numbers, not the {np.prod(shape)} of a {shape} matrix"
        raise fault(path, message, _REMEDY)
    return found.reshape(shape)


def read_stamps(path: Path) -> list[int | None]:
    """Line k is the stamp of frame k, nanoseconds since 1970 by the local clock; None where the line is empty.

    Lines are empty where a file was lost (drive 2011_09_26_0009). Raises LogError for lines that are no stamps.
    """
    return [_nanoseconds(line, path, number) if line else None for number, line in enumerate(read_lines(path), 1)]


def _nanoseconds(line: str, path: Path, number: int) -> int:
    match = _STAMP.fullmatch(line)
    if match is None:
        raise fault(path, f"line {number} is {line[:40]!r}, no YYYY-MM-DD hh:mm:ss.fraction", _REMEDY)
    *parts, fraction = match.groups()
    year, month, day, hour, minute, second = map(int, parts)
    if not (1970 <= year < 2200 and 1 <= month <= 12 and 1 <= day <= calendar.monthrange(year, month)[1]):
        raise fault(path, f"line {number} has the date {line[:10]}, which no calendar has", _REMEDY)
    if hour > 23 or minute > 59 or second > 60:
        raise fault(path, f"line {number} has the time {line[11:19]}, which no clock shows", _REMEDY)
    seconds = calendar.timegm((year, month, day, hour, minute, second))
    return 1_000_000_000 * seconds + int((fraction or "0").ljust(9, "0"))


COLOR = ("image_02", "image_03")
GRAY = ("image_00", "image_01")
_NAME = re.compile(r"(\d{4}_\d\d_\d\d)_drive_\d{4}")
_NO_DRIVES = "there are no folders DATE/DATE_drive_NNNN_sync below data.root, which must be the folder of the dates"
_REMEDY_FOLDER = "set data.root and data.log.drive, or unpack the archive there"


@dataclass(frozen=True)
class Drive:
    """The folder of a drive, and the frames and cameras of it that are read. Frame k has files of the name k."""

    folder: Path
    cameras: tuple[str, ...]
    frames: range

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
    return Drive(folder, chosen, frames)


def _folder(root: Path, name: str | None) -> Path:
    """Of the drive of a name, or of the only one."""
    found = {path.name.removesuffix("_sync"): path for path in sorted(root.glob("*/*_drive_*_sync"))}
    there = f"the drives in {root} are {listed(list(found))}"
    if name is None:
        if len(found) > 1:
            raise ValueError(f"{there}: name one (data.log.drive)")
        if not found:
            raise fault(root, _NO_DRIVES, _REMEDY_FOLDER)
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
    raise fault(folder, message, _REMEDY_FOLDER)


def numbered(folder: Path, suffix: str) -> set[int]:
    """The numbers in the names of a folder's files that are ten digits and the suffix."""
    if not folder.is_dir():
        return set()
    return {int(path.stem) for path in folder.iterdir() if path.suffix == suffix and re.fullmatch(r"\d{10}", path.stem)}


_REMEDY_STAMPS = "copy it again from the published archive, or read other frames (data.log.first_frame, .last_frame)"


@dataclass(frozen=True)
class DriveClock:
    """Nanoseconds of the window's frames, and what was missing."""

    stamps: tuple[int, ...]
    notes: tuple[str, ...]


def read_clock(drive: Drive) -> DriveClock:
    """Stamps of the lidar, those of images less their usual lag where the lidar has none.

    The images' own stamps are the recording computer's: in drive 2011_09_26_0005 they are 10 to 17 ms late, by another
    time for each camera.
    Raises LogError for files that give no increasing stamps.
    """
    path = drive.image_stamps(drive.cameras[0])
    images = at_frames(read_stamps(path), drive.frames)
    if not drive.lidar_stamps().is_file():
        return DriveClock(increasing(images, drive.frames, path), ("no clock of the lidar: the images' one is taken",))
    lidar = at_frames(read_stamps(drive.lidar_stamps()), drive.frames)
    lags = [image - turn for image, turn in zip(images, lidar, strict=True) if image is not None and turn is not None]
    if not lags:
        message = f"frames {drive.frames[0]} to {drive.frames[-1]} have no stamps"
        raise fault(drive.lidar_stamps(), message, _REMEDY_STAMPS)
    lag, filled = median_low(lags), sum(turn is None for turn in lidar)
    stamps = [
        turn if turn is not None or image is None else image - lag for image, turn in zip(images, lidar, strict=True)
    ]
    note = f"{filled} frames without a stamp of the lidar: the image's, less its usual lag, is taken"
    return DriveClock(increasing(stamps, drive.frames, drive.lidar_stamps()), (note,) if filled else ())


def read_turns(drive: Drive, clock: DriveClock) -> tuple[dict[int, tuple[int, int]], list[Problem]]:
    """Begin and end of the lidar's turn at each frame of the window that has a sweep, and what is wrong with them."""
    first, last = (drive.lidar_stamps(which) for which in ("_start", "_end"))
    begins, ends = (at_frames(read_stamps(path), drive.frames) for path in (first, last))
    turns, problems = {}, []
    for place, frame in enumerate(drive.frames):
        if not drive.sweep(frame).is_file():
            continue
        begin, stamp, end = begins[place], clock.stamps[place], ends[place]
        if begin is None or end is None:
            path = first if begin is None else last
            problems.append(Problem(path, f"frame {frame} has a sweep, and no stamp here", _REMEDY_STAMPS))
        elif not (begin <= stamp <= end and end - begin < 1_000_000_000):
            message = f"at frame {frame} the turn from {begin} to {end} ns is no second around {stamp} ns"
            problems.append(Problem(first, message, _REMEDY_STAMPS))
        else:
            turns[frame] = begin, end
    return turns, problems


def at_frames(stamps: Sequence[int | None], frames: Sequence[int]) -> list[int | None]:
    """Line k is that of frame k; None where a file ends early."""
    return [stamps[frame] if frame < len(stamps) else None for frame in frames]


def increasing(stamps: Sequence[int | None], frames: Sequence[int], path: Path) -> tuple[int, ...]:
    """Raise LogError unless each frame has a stamp, later than the one before."""
    found: list[int] = []
    for frame, stamp in zip(frames, stamps, strict=True):
        if stamp is None:
            raise fault(path, f"line {frame + 1}, of frame {frame}, is empty or missing", _REMEDY_STAMPS)
        if found and stamp <= found[-1]:
            raise fault(path, f"line {frame + 1}, of frame {frame}, is not later than the one before", _REMEDY_STAMPS)
        found.append(stamp)
    return tuple(found)


_REMEDY_CALIBRATION = "copy the calibration of this date again from the published archive"


@dataclass(frozen=True)
class RectifiedCamera:
    """One camera after rectification: a pinhole without a lens."""

    intrinsics: Float64[Tensor, "3 3"]
    """Pixel centers at +0.5; the files count from the center of the first pixel."""
    camera_from_rectified: Float64[Tensor, "4 4"]
    """From the rectified frame of camera 0, which all four share but for their place."""
    size: tuple[int, int]
    """(width, height)."""


@dataclass(frozen=True)
class Calibration:
    imu_from_lidar: Float64[Tensor, "4 4"]
    imu_from_camera: Mapping[str, Float64[Tensor, "4 4"]]
    cameras: Mapping[str, RectifiedCamera]
    """By the name of the folder: image_00 to image_03."""


def read_calibration(folder: Path, cameras: Sequence[str]) -> Calibration:
    """Those of a date's three files; raises LogError with all that is wrong in them.

    camera_from_lidar = [I | K^-1 p] R_rect_00 velo_to_cam, where P_rect of the camera is [K | p]. The rotation is that
    of camera 0 for all cameras: the rectified frame is common.
    """
    problems: list[Problem] = []
    imu_path, lidar_path, path = (folder / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam"))
    lidar_from_imu = attempt(problems, lambda: _read_rigid(imu_path))
    camera_from_lidar = attempt(problems, lambda: _read_rigid(lidar_path))
    table = attempt(problems, lambda: read_keyed(path)) or {}
    found: dict[str, RectifiedCamera] = {}
    rotation = None
    if table:
        rotation = attempt(problems, lambda: rectifying_rotation(table, "00", path))
        for name in cameras:
            camera = attempt(problems, lambda number=name[-2:]: rectified_camera(table, number, path))
            if camera is not None:
                found[name] = camera
    if problems or lidar_from_imu is None or camera_from_lidar is None or rotation is None:
        raise LogError(problems)
    imu_from_lidar, rectified_from_lidar = inverse(lidar_from_imu), rotation @ camera_from_lidar
    places = {
        name: imu_from_lidar @ inverse(camera.camera_from_rectified @ rectified_from_lidar)
        for name, camera in found.items()
    }
    return Calibration(imu_from_lidar, places, found)


def rectified_camera(table: Mapping[str, str], number: str, path: Path) -> RectifiedCamera:
    """From the lines P_rect_XX and S_rect_XX; raises LogError."""
    projection = keyed_numbers(table, f"P_rect_{number}", (3, 4), path)
    width, height = keyed_numbers(table, f"S_rect_{number}", (2,), path)
    size = image_sides(width, height, path, f"S_rect_{number}")
    matrix = projection[:, :3]
    focal_only = np.array([[1, 0, 1], [0, 1, 1], [0, 0, 0]], dtype=bool)
    pinhole = not (matrix[~focal_only] - np.eye(3)[~focal_only]).any() and matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not pinhole:
        message = f"P_rect_{number} is no [K | p] of a pinhole: its left part is {matrix.tolist()}"
        raise fault(path, message, _REMEDY_CALIBRATION)
    place = torch.eye(4, dtype=torch.float64)
    # Not p_x / f as often taken: the third entry of p is 3 mm on KITTI's color cameras, and moves x by 2.3 mm too.
    place[:3, 3] = torch.from_numpy(np.linalg.solve(matrix, projection[:, 3]))
    intrinsics = torch.from_numpy(matrix.copy())
    intrinsics[:2, 2] += 0.5
    return RectifiedCamera(intrinsics, place, size)


def image_sides(width: float, height: float, path: Path, what: str) -> tuple[int, int]:
    """Raise LogError unless the numbers can be an image's sides in pixels."""
    if not all(1 <= side <= 16384 and side % 1 == 0 for side in (width, height)):
        raise fault(path, f"{what} is {width:g} x {height:g}, no size of an image", _REMEDY_CALIBRATION)
    return int(width), int(height)


def rectifying_rotation(table: Mapping[str, str], number: str, path: Path) -> Float64[Tensor, "4 4"]:
    """R_rect_XX as a transform; raises LogError."""
    rotation = keyed_numbers(table, f"R_rect_{number}", (3, 3), path)
    return rigid(rotation, np.zeros(3), path, f"R_rect_{number}")


def rigid(
    rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, "3"], path: Path, what: str
) -> Float64[Tensor, "4 4"]:
    """Raise LogError unless the rotation is one."""
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3], transform[:3, 3] = torch.from_numpy(rotation), torch.from_numpy(translation)
    check_rigid(transform, path, what)
    return transform


def _read_rigid(path: Path) -> Float64[Tensor, "4 4"]:
    """The lines R and T."""
    table = read_keyed(path)
    return rigid(keyed_numbers(table, "R", (3, 3), path), keyed_numbers(table, "T", (3,), path), path, "[R | T]")


OWN_CAR = 2.5
"""Meters: in the sample of drive 2011_09_26_0005 the 34 returns nearer than this are of the car, the next is at 2.6."""
_MAX_SWEEP_BYTES = 1 << 24
"""Bytes, a million points; a sweep has 120,000."""
_REMEDY_SWEEP = "copy it again from the published archive, or remove it to read its frame without lidar"


def read_returns(path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Points (x forward, y left, z up) and reflectances, without the own car; LogError for a file that is no sweep."""
    points, reflectances = sensor_returns(path, 4, 1.0, max_bytes=_MAX_SWEEP_BYTES, remedy=_REMEDY_SWEEP)
    others = points.norm(dim=-1) >= OWN_CAR
    return points[others], reflectances[others]


def read_points(path: Path) -> Float64[Tensor, "n 3"]:
    """The points of ``read_returns``."""
    return read_returns(path)[0]


def read_intensities(path: Path) -> Float[Tensor, " n"]:
    """The reflectances of ``read_returns``."""
    return read_returns(path)[1]


def point_stamps(points: Float64[Tensor, "n 3"], begin: int, end: int) -> Int64[Tensor, " n"]:
    """When each point was measured in a turn from ``begin`` to ``end``, nanoseconds.

    Seen from above the sensor turns clockwise, from behind over left, front and right:
    begin + (pi - atan2(y, x)) / (2 pi) (end - begin). KITTI's readme says counter-clockwise, but edges of the lidar lie
    on edges of the images best for a clockwise turn (tests/data/kitti/test_genuine.py), and KITTI-360's development kit
    moves points so too.
    """
    fraction = (torch.pi - torch.atan2(points[:, 1], points[:, 0])) / (2 * torch.pi)
    return begin + (fraction * (end - begin)).round().long()


_MAX_DEPTH = 64


def elements(path: Path, depth: int, *, max_bytes: int, remedy: str) -> Iterator[Element]:
    """Yield the elements at a depth, the root's being 0; each is emptied once the next is asked for.

    A document may name its type, as boost's archives do. It may not declare entities or refer to other files.

    Args:
        path: of the document.
        depth: of the elements.
        max_bytes: size of a file above which it is refused.
        remedy: what to do about a document that cannot be read.

    Raises LogError for a file that is missing, too large, or no such document.
    """
    try:
        check_regular(path)
        if (size := path.stat().st_size) > max_bytes:
            raise fault(path, f"the file has {size} bytes, more than the {max_bytes} that are read", remedy)
        level = -1
        for event, element in iterparse(str(path), ("start", "end"), forbid_dtd=False):
            level += 1 if event == "start" else 0
            if level > _MAX_DEPTH:
                raise fault(path, f"elements lie more than {_MAX_DEPTH} deep", remedy)
            if event == "end":
                if level == depth:
                    yield element
                if level <= depth:
                    element.clear()
                level -= 1
    except OSError as error:
        raise fault(path, f"the file cannot be read ({error})", remedy) from error
    except (DefusedXmlException, ParseError, LookupError) as error:
        raise fault(path, f"the file is no XML that can be read ({error})", remedy) from error
