"""From a drive of KITTI's raw data to a DrivingLog."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.extent import check_extent
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.kitti.calibration import Calibration, read_calibration
from sparsestreet.data.kitti.clock import DriveClock, read_clock, read_turns
from sparsestreet.data.kitti.contents import Pixels, check_recording
from sparsestreet.data.kitti.layout import GRAY, Drive, find_drive
from sparsestreet.data.kitti.oxts import Oxts, read_oxts
from sparsestreet.data.kitti.tracklets import Tracklet, read_tracklets
from sparsestreet.data.kitti.velodyne import point_stamps, read_points
from sparsestreet.data.marks import Marks
from sparsestreet.data.motion import PosePath, untwisted
from sparsestreet.data.problems import LogError, Problem, attempt, missing_files
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage, RecordedReader, Recording
from sparsestreet.geometry.cameras import transform_points

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

    marks = Marks(("????_??_??/*_drive_*_sync", "????_??_??/*_drive_*_extract"))

    drive: str | int | None = None
    """Such as 2011_09_26_drive_0001; None: the only one."""

    def recording(self) -> Recording:
        drive, parts = self._drive(), self._parts()
        cameras = [parts.calibration.cameras[name] for name in drive.cameras]
        rig = tuple(
            self.pinhole(name, index, camera.intrinsics, camera.size)
            for index, (name, camera) in enumerate(zip(drive.cameras, cameras, strict=True))
        )
        sizes = tuple(camera.size for camera in cameras)
        given = None if self.masks is None else GivenMasks(Path(self.masks))
        pixels = Pixels(rig, sizes, given)
        return Recording(
            name=drive.name,
            rig=rig,
            shots=_shots(drive, parts),
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=frozenset() if given is None else given.kinds,
            frame_stamps=parts.clock.stamps,
            sweeps=_sweeps(drive, parts) if self.lidar and drive.lidar.is_dir() else None,
            boxes=None if parts.tracklets is None else _boxes(drive, parts, parts.tracklets),
            vehicle=PosePath(
                torch.tensor(parts.clock.stamps), torch.stack([parts.poses[frame] for frame in drive.frames])
            ),
            notes=(_POSES, *parts.clock.notes, *self._notes(drive, parts)),
        )

    def check_contents(self) -> list[Problem]:
        return check_recording(self.recording())

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
        """Raises LogError with all that is wrong in the drive's tables."""
        drive = self._drive()
        images = [drive.image(camera, frame) for camera, frame in product(drive.cameras, drive.frames)]
        problems = missing_files([*images, *map(drive.oxts, drive.frames)])
        if self.masks is not None:
            stems = product(drive.cameras, (drive.image("", frame).stem for frame in drive.frames))
            problems += GivenMasks(Path(self.masks)).check(stems)
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
        place: LidarSweep(partial(_read_sweep, drive, parts, place), parts.clock.stamps[place])
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
