"""From a drive of KITTI's raw data to a DrivingLog."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from sparsestreet.data.kitti.files import (
    GRAY,
    Calibration,
    Drive,
    DriveClock,
    elements,
    find_drive,
    numbers,
    point_stamps,
    read_calibration,
    read_clock,
    read_intensities,
    read_lines,
    read_points,
    read_turns,
)
from sparsestreet.data.poses import PosePath, check_extent, untwisted
from sparsestreet.data.problems import LogError, Problem, attempt, fault, missing_files
from sparsestreet.data.reader import FolderSignature, LogFiles
from sparsestreet.data.recorded_images import Pixels, RecordedImage
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.geometry.cameras import transform_points

EARTH_RADIUS = 6378137.0
FASTEST, FASTEST_TURN = 150.0, 20.0
"""m/s and rad/s beyond which no car moves."""
_MAX_POSE_BYTES = 1 << 16
_STEPS = 32
"""Straight parts of the arc of a sweep: at 10 m/s and 0.3 rad/s they miss it by 4 micrometers."""
_REMEDY_POSE = "copy it again from the published archive, or read other frames (data.log.first_frame, .last_frame)"


@dataclass(frozen=True)
class Oxts:
    """What the inertial system says of one frame. Its axes are x forward, y left, z up."""

    latitude: float
    """Degrees."""
    longitude: float
    altitude: float
    rotation: Float64[np.ndarray, "3 3"]
    """world_from_imu; x east, y north, z up."""
    velocity: Float64[np.ndarray, "3"]
    """m/s, in the IMU's axes."""
    turn: Float64[np.ndarray, "3"]
    """rad/s about the IMU's axes."""

    @property
    def mercator_scale(self) -> float:
        return float(np.cos(np.radians(self.latitude)))

    def world_from_imu(self, scale: float) -> Float64[Tensor, "4 4"]:
        """Mercator's projection at the scale of the drive's first frame, as the development kit has it:
        x = s r lon, y = s r ln tan(pi / 4 + lat / 2)."""
        radius = scale * EARTH_RADIUS
        north = np.log(np.tan(np.pi * (90 + self.latitude) / 360))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(self.rotation)
        pose[:3, 3] = torch.tensor([radius * np.radians(self.longitude), radius * north, self.altitude])
        return pose

    def path(self, pose: Float64[Tensor, "4 4"], stamp: int, begin: int, end: int) -> PosePath:
        """world_from_imu from ``begin`` to ``end``, where it is ``pose`` at ``stamp`` and its motion stays the same.

        The measured motion and not the neighbors' poses: the latter jump by centimeters where GPS corrects them.
        """
        twist = torch.zeros(4, 4, dtype=torch.float64)
        x, y, z = self.turn
        twist[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        twist[:3, 3] = torch.from_numpy(self.velocity)
        stamps = torch.tensor([begin + step * (end - begin) // _STEPS for step in range(_STEPS + 1)])
        seconds = (stamps - stamp).double() / 1e9
        return PosePath(stamps, pose @ torch.linalg.matrix_exp(seconds[:, None, None] * twist))


def read_oxts(path: Path) -> Oxts:
    """One frame's file of 30 numbers; raises LogError for a file that is no such thing."""
    words = " ".join(read_lines(path, _MAX_POSE_BYTES)).split()
    if len(words) != 30:
        raise fault(path, f"a frame of GPS and IMU has 30 numbers, this file has {len(words)}", _REMEDY_POSE)
    values = numbers(words, path, "the file")
    latitude, longitude, altitude, _, _, _, north, east, _, _, up = values[:11]
    limits = {
        "latitude": (latitude, 85.0),
        "longitude": (longitude, 360.0),
        "altitude": (altitude, 1e4),
        "angle": (np.abs(values[3:6]).max(), 2 * np.pi + 1e-6),
        "velocity": (np.abs([north, east, up]).max(), FASTEST),
        "angular rate": (np.abs(values[17:20]).max(), FASTEST_TURN),
    }
    for what, (value, most) in limits.items():
        if abs(value) > most:
            raise fault(path, f"the {what} {value:g} is beyond {most:g}, no car's", _REMEDY_POSE)
    (rotation,) = rotations(values[None, 3:6])
    return Oxts(latitude, longitude, altitude, rotation, rotation.T @ np.array([east, north, up]), values[17:20])


_MAX_TRACKLETS_BYTES = 1 << 25
"""Bytes; 15 objects of 100 frames take 0.3 MB."""
_UNSET = 0
"""State of a pose that nobody gave."""
_FARTHEST = 1000.0
"""Meters."""
_REMEDY = "copy it again from the published archive, or remove it to read the drive without boxes"


@dataclass(frozen=True)
class Tracklet:
    """One object: its frames and, at each, its box in the frame of the lidar."""

    class_name: str
    size: Float64[np.ndarray, "3"]
    """Length, width, height, meters."""
    frames: Int[np.ndarray, " f"]
    lidar_from_object: Float64[Tensor, "f 4 4"]
    """x along the length, y left, z up, from the center."""
    num_unset: int
    """Poses that were left out because nobody gave them."""


def read_tracklets(path: Path) -> list[Tracklet]:
    """In the order of the file; raises LogError with every object at fault."""
    found, problems, announced = [], [], None
    for item in elements(path, 2, max_bytes=_MAX_TRACKLETS_BYTES, remedy=_REMEDY):
        try:
            if item.tag == "item":
                found.append(_tracklet(item, path, f"object {len(found) + len(problems)}"))
            elif item.tag == "count":
                announced = numbers([item.text or ""], path, "count")[0]
        except LogError as error:
            problems += error.problems
    if not problems and announced != len(found):
        problems.append(Problem(path, f"it announces {announced} objects and holds {len(found)}", _REMEDY))
    if problems:
        raise LogError(problems)
    return found


def _tracklet(item: Element, path: Path, what: str) -> Tracklet:
    class_name = (item.findtext("objectType") or "").strip()
    height, width, length, first = _values(item, ("h", "w", "l", "first_frame"), path, what)
    if not class_name or not (0 <= first < 1e6) or first % 1:
        message = f"{what} has the class {class_name!r} and the first frame {first:g}"
        raise fault(path, message, _REMEDY)
    if min(height, width, length) <= 0 or max(height, width, length) > 100:
        raise fault(path, f"{what} is {length:g} m long, {width:g} m wide and {height:g} m high", _REMEDY)
    boxes = item.findall("poses/item")
    keys = ("tx", "ty", "tz", "rx", "ry", "rz", "state")
    rows = np.array([_values(box, keys, path, f"{what}, pose {place}") for place, box in enumerate(boxes)])
    rows = rows.reshape(len(boxes), len(keys))
    if np.abs(rows[:, :3]).max(initial=0) > _FARTHEST:
        raise fault(path, f"{what} lies {np.abs(rows[:, :3]).max():g} m away, farther than a lidar sees", _REMEDY)
    kept = rows[:, 6] != _UNSET
    poses = _poses(rows[kept], height)
    frames = int(first) + np.flatnonzero(kept)
    return Tracklet(class_name, np.array([length, width, height]), frames, poses, int((~kept).sum()))


def _poses(rows: Float64[np.ndarray, "f 7"], height: float) -> Float64[Tensor, "f 4 4"]:
    """From the center of the bottom to that of the box; yaw counts past half a turn, which its sine does not mind."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotations(rows[:, 3:6])
    poses[:, :3, 3] = rows[:, :3] + 0.5 * height * poses[:, :3, 2]
    return torch.from_numpy(poses)


def rotations(angles: Float64[np.ndarray, "f 3"]) -> Float64[np.ndarray, "f 3 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll) of roll, pitch and yaw."""
    roll, pitch, yaw = angles.T
    return _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)


def _about(axis: int, angles: Float64[np.ndarray, " f"]) -> Float64[np.ndarray, "f 3 3"]:
    """Rotations about x, y or z."""
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turns[:, first, first] = turns[:, second, second] = np.cos(angles)
    turns[:, first, second], turns[:, second, first] = -np.sin(angles), np.sin(angles)
    return turns


def _values(item: Element, keys: tuple[str, ...], path: Path, what: str) -> Float64[np.ndarray, " n"]:
    missing = [key for key in keys if item.find(key) is None]
    if missing:
        raise fault(path, f"{what} lacks {', '.join(missing)}", _REMEDY)
    return numbers([item.findtext(key) or "" for key in keys], path, f"{what} ({', '.join(keys)})")


_POSES = "poses are those of GPS and IMU, as shipped: where they err, images and lidar of different frames disagree"


@dataclass(frozen=True)
class _Parts:
    """What was found in a drive's tables."""

    calibration: Calibration
    clock: DriveClock
    oxts: Mapping[int, Oxts]
    """By frame."""
    poses: Mapping[int, Float64[Tensor, "4 4"]]
    """world_from_imu by frame."""
    turns: Mapping[int, tuple[int, int]]
    """Begin and end of the lidar's turn, nanoseconds, by frame that has one."""
    tracklets: list[Tracklet] | None


@dataclass(frozen=True, kw_only=True)
class KittiReader(RecordedReader):
    """A drive of KITTI's raw data, synchronized and rectified.

    ``root`` is the folder of the dates. Frame k has the files of the name k. Its instant is the one at which the lidar
    faced forward, which triggered all four cameras. The world is Mercator's plane: x east, y north, z up.
    """

    marks = FolderSignature(("????_??_??/*_drive_*_sync", "????_??_??/*_drive_*_extract"))

    drive: str | int | None = None
    """Such as 2011_09_26_drive_0001; None: the only one."""

    def recording(self) -> Recording:
        drive, parts = self._drive(), self._parts()
        cameras = [parts.calibration.cameras[name] for name in drive.cameras]
        rig = tuple(
            self.pinhole(name, index, camera.intrinsics, camera.size)
            for index, (name, camera) in enumerate(zip(drive.cameras, cameras, strict=True))
        )
        pixels = Pixels(rig, [camera.size for camera in cameras], self.given)
        return Recording(
            name=drive.name,
            rig=rig,
            shots=_shots(drive, parts),
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=self.given.beside(()),
            frame_stamps=parts.clock.stamps,
            sweeps=_sweeps(drive, parts) if self.lidar and drive.lidar.is_dir() else None,
            boxes=None if parts.tracklets is None else _boxes(drive, parts, parts.tracklets),
            vehicle=PosePath(
                torch.tensor(parts.clock.stamps), torch.stack([parts.poses[frame] for frame in drive.frames])
            ),
            notes=(_POSES, *parts.clock.notes, *self._notes(drive, parts)),
        )

    def files(self) -> LogFiles:
        """Those of the chosen frames and cameras, lidar too where it is not wanted."""
        drive = self._drive()
        described = [*_calibration_files(drive), *map(drive.oxts, drive.frames), drive.oxts(drive.first_oxts)]
        described += [drive.tracklets, *map(drive.image_stamps, drive.cameras)]
        described += map(drive.lidar_stamps, ("", "_start", "_end"))
        recorded = [drive.image(camera, frame) for frame, camera in product(drive.frames, drive.cameras)]
        return LogFiles(described, recorded + [drive.sweep(frame) for frame in drive.frames])

    def _drive(self) -> Drive:
        return find_drive(self.folder, self.drive, self.cameras, self.first_frame, self.last_frame)

    def _parts(self) -> _Parts:
        """Raise LogError with all that is wrong in the drive's tables."""
        drive = self._drive()
        images = [drive.image(camera, frame) for camera, frame in product(drive.cameras, drive.frames)]
        problems = missing_files([*images, *map(drive.oxts, drive.frames)])
        stems = (drive.image("", frame).stem for frame in drive.frames)
        problems += self.given.check(product(drive.cameras, stems))
        calibration = attempt(problems, lambda: read_calibration(drive.folder.parent, drive.cameras))
        clock = attempt(problems, lambda: read_clock(drive))
        oxts, poses = _read_poses(drive, problems)
        turns = {}
        if clock is not None and self.lidar and drive.lidar.is_dir():
            turns, wrong = attempt(problems, lambda: read_turns(drive, clock)) or ({}, [])
            problems += wrong
        tracklets = attempt(problems, lambda: read_tracklets(drive.tracklets)) if drive.tracklets.is_file() else None
        problems += check_extent([(drive.oxts(frame), pose[:3, 3]) for frame, pose in poses.items()])
        if problems or calibration is None or clock is None:
            raise LogError(problems)
        return _Parts(calibration, clock, oxts, poses, turns, tracklets)

    def _notes(self, drive: Drive, parts: _Parts) -> list[str]:
        notes = [f"camera {name} records gray, not colors" for name in drive.cameras if name in GRAY]
        without = len(drive.frames) - len(parts.turns)
        if self.lidar and drive.lidar.is_dir() and without:
            notes.append(f"{without} of {len(drive.frames)} frames have no lidar file: they have no points")
        unset = sum(tracklet.num_unset for tracklet in parts.tracklets or ())
        if unset:
            notes.append(f"{unset} boxes are left out, whose place nobody gave (state 0)")
        return notes


def _calibration_files(drive: Drive) -> list[Path]:
    return [drive.folder.parent / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam", "cam_to_cam")]


def _read_poses(drive: Drive, problems: list[Problem]) -> tuple[dict[int, Oxts], dict[int, Float64[Tensor, "4 4"]]]:
    """Of the frames that have a file; what is wrong is added to the problems."""
    found = {
        frame: attempt(problems, partial(read_oxts, drive.oxts(frame)))
        for frame in sorted({drive.first_oxts, *drive.frames})
        if drive.oxts(frame).is_file()
    }
    oxts = {frame: one for frame, one in found.items() if one is not None}
    if drive.first_oxts not in oxts:
        return {}, {}
    scale = oxts[drive.first_oxts].mercator_scale
    return oxts, {frame: one.world_from_imu(scale) for frame, one in oxts.items() if frame in drive.frames}


def _shots(drive: Drive, parts: _Parts) -> list[RecordedImage]:
    shots = []
    for place, frame in enumerate(drive.frames):
        for index, name in enumerate(drive.cameras):
            pose = parts.poses[frame] @ parts.calibration.imu_from_camera[name]
            path = drive.image(name, frame)
            shots.append(RecordedImage(place, index, pose, path, path.stem, parts.clock.stamps[place]))
    return shots


def _sweeps(drive: Drive, parts: _Parts) -> dict[int, LidarSweep]:
    return {
        place: LidarSweep(
            partial(_read_sweep, drive, parts, place),
            parts.clock.stamps[place],
            (parts.poses[frame] @ parts.calibration.imu_from_lidar)[:3, 3],
            partial(read_intensities, drive.sweep(frame)),
        )
        for place, frame in enumerate(drive.frames)
        if frame in parts.turns
    }


def _read_sweep(drive: Drive, parts: _Parts, place: int) -> Float64[Tensor, "n 3"]:
    """Points in the world, each from where the car was when the turning lidar saw it."""
    frame, imu_from_lidar = drive.frames[place], parts.calibration.imu_from_lidar
    points, (begin, end) = read_points(drive.sweep(frame)), parts.turns[frame]
    path = parts.oxts[frame].path(parts.poses[frame], parts.clock.stamps[place], begin, end)
    return untwisted(transform_points(imu_from_lidar, points), point_stamps(points, begin, end), path)


def _boxes(drive: Drive, parts: _Parts, tracklets: list[Tracklet]) -> list[Boxes]:
    """Those at the frames of the window, at the instants of these frames."""
    found = []
    for number, tracklet in enumerate(tracklets):
        inside = np.flatnonzero((tracklet.frames >= drive.frames.start) & (tracklet.frames < drive.frames.stop))
        if not len(inside):
            continue
        frames = tracklet.frames[inside]
        lidar = torch.stack([parts.poses[frame] @ parts.calibration.imu_from_lidar for frame in frames.tolist()])
        found.append(
            Boxes(
                str(number),
                tracklet.class_name,
                frames - drive.frames.start,
                (lidar @ tracklet.lidar_from_object[inside]).numpy(),
                np.tile(tracklet.size, (len(frames), 1)),
                drive.tracklets,
            )
        )
    return found
