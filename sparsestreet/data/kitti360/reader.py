"""From a sequence of KITTI-360 to a DrivingLog."""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from statistics import median_low

import numpy as np
import torch
from jaxtyping import Bool, Float64
from PIL import Image
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.kitti.files import (
    at_frames,
    increasing,
    point_stamps,
    read_intensities,
    read_points,
    read_stamps,
)
from sparsestreet.data.kitti360.files import (
    FISHEYE,
    Calibration360,
    FisheyeCamera,
    SequenceFolders,
    find_sequence,
    read_boxes,
    read_calibration,
    read_poses,
)
from sparsestreet.data.poses import RIGIDITY_TOLERANCE, PosePath, are_rigid, check_extent, check_rigid, untwisted
from sparsestreet.data.problems import LogError, attempt, fault, missing_files
from sparsestreet.data.reader import FolderSignature, LogFiles
from sparsestreet.data.recorded_images import Masks, Pixels, RecordedImage, check_size
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera, lens_camera
from sparsestreet.geometry.cameras import rigidity_error, transform_points

KINDS = {"sky": (23,), "human": (24, 25, 32, 33), "vehicle": (26, 27, 28, 29, 30, 31)}
"""Class numbers of the label images. Two-wheelers are of the kind human, as in DriveStudio's masks: person, rider,
motorcycle, bicycle; car, truck, bus, caravan, trailer, train."""


def read_semantics(path: Path, recorded_size: tuple[int, int], size: tuple[int, int]) -> dict[str, Bool[Tensor, "h w"]]:
    """Kind -> mask at (width, height) ``size``, of the nearest pixels; raises LogError for a broken label image."""
    check_size(path, recorded_size)
    try:
        check_regular(path)
        with Image.open(path) as image:
            if image.mode not in ("L", "P"):
                message = f"a label image has one number of 8 bits a pixel, this has the mode {image.mode}"
                raise fault(path, message, "copy it again from the published archive")
            labels = np.array(image.resize(size, Image.Resampling.NEAREST))
    except (OSError, SyntaxError) as error:  # Pillow reports a broken PNG chunk as SyntaxError
        raise fault(path, f"the labels cannot be decoded ({error})", "copy them again, or remove them") from error
    return {kind: torch.from_numpy(np.isin(labels, numbers)) for kind, numbers in KINDS.items()}


_TURN = 103_300_000
"""Nanoseconds of the lidar's turn, where the stamps of the images do not tell."""


@dataclass(frozen=True)
class _Parts:
    """What was found in a sequence's tables."""

    frames: tuple[int, ...]
    """Those of the window that have poses; the log counts them from 0."""
    calibration: Calibration360
    stamps: tuple[int, ...]
    path: PosePath
    """world_from_imu over the window and one pose beyond either end."""
    turn: int
    """Nanoseconds of the lidar's turn."""
    boxes: list[Boxes] | None
    num_unposed: int


@dataclass(frozen=True, kw_only=True)
class Kitti360Reader(RecordedReader):
    """Frames of a sequence of KITTI-360 that have poses; by default of the rectified cameras image_00 and image_01.

    ``first_frame`` and ``last_frame`` are the data set's own numbers. Cameras and lidar share the instant of their
    frame, for which the images' stamps stand. The world is that of the shipped poses.
    """

    marks = FolderSignature(("data_2d_raw/*_drive_*_sync",))

    sequence: int | str | None = None
    """0, 2 to 10 or 18; None: the only one."""
    pinhole_fov: float | None = None
    """Degrees that the pinholes see which the fisheyes are resampled to (``rig.lens_camera``); None: by their
    resolution."""

    def recording(self) -> Recording:
        sequence, parts = self._sequence(), self._parts()
        rig = tuple(self._rig_camera(parts.calibration, index, name) for index, name in enumerate(sequence.cameras))
        sizes = tuple(parts.calibration.cameras[name].size for name in sequence.cameras)
        labeled = _labeled(sequence, parts.frames) if self.masks is None else set()
        pixels = Pixels(rig, sizes, self.given, partial(_labels, sequence, rig, sizes, labeled))
        return Recording(
            name=sequence.name.removesuffix("_sync"),
            rig=rig,
            shots=_shots(sequence, parts),
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=self.given.beside(KINDS if labeled else ()),
            frame_stamps=parts.stamps,
            sweeps=_sweeps(sequence, parts) if self.lidar and sequence.lidar.is_dir() else None,
            boxes=parts.boxes,
            notes=self._notes(sequence, parts, len(labeled)),
        )

    def files(self) -> LogFiles:
        """Those of the chosen frames and cameras, lidar too where it is not wanted."""
        sequence = self._sequence()
        frames = self._window(sequence, read_poses(sequence.poses))
        names = ["calib_cam_to_pose.txt", "calib_cam_to_velo.txt", "perspective.txt"]
        names += [f"{camera}.yaml" for camera in FISHEYE if camera in sequence.cameras]
        described = [sequence.poses, *(sequence.calibration / name for name in names)]
        described += [sequence.stamps(sequence.cameras[0]), *([sequence.boxes] if sequence.boxes else [])]
        recorded = [sequence.image(camera, frame) for frame, camera in product(frames, sequence.cameras)]
        recorded += [path for _, path in sorted(_labeled(sequence, frames))]
        return LogFiles(described, recorded + [sequence.sweep(frame) for frame in frames])

    def _sequence(self) -> SequenceFolders:
        return find_sequence(self.folder, self.sequence, self.cameras)

    def _window(self, sequence: SequenceFolders, poses: dict[int, Float64[Tensor, "4 4"]]) -> tuple[int, ...]:
        last = max(poses) if self.last_frame == -1 else self.last_frame
        frames = tuple(frame for frame in poses if self.first_frame <= frame <= last)
        if not frames:
            raise ValueError(
                f"no frame from {self.first_frame} to {self.last_frame} has a pose: those of {sequence.name} lie "
                f"between {min(poses)} and {max(poses)} (data.log.first_frame, .last_frame)"
            )
        return frames

    def _parts(self) -> _Parts:
        """Raise LogError with all that is wrong in the sequence's tables."""
        sequence = self._sequence()
        poses = read_poses(sequence.poses)
        frames = self._window(sequence, poses)
        images = [sequence.image(camera, frame) for camera, frame in product(sequence.cameras, frames)]
        problems = missing_files(images)
        stems = (sequence.image("", frame).stem for frame in frames)
        problems += self.given.check(product(sequence.cameras, stems))
        if not are_rigid(torch.stack([poses[frame] for frame in frames])):
            for frame in frames:
                attempt(problems, partial(check_rigid, poses[frame], sequence.poses, f"the pose of frame {frame}"))
        problems += check_extent([(sequence.poses, poses[frame][:3, 3]) for frame in frames])
        calibration = attempt(problems, lambda: read_calibration(sequence.calibration, sequence.cameras))
        lines = attempt(problems, lambda: read_stamps(sequence.stamps(sequence.cameras[0]))) or []
        stamps = attempt(problems, lambda: _stamps(sequence, lines, frames)) if lines else None
        path, positions = sequence.boxes, torch.stack([poses[frame][:3, 3] for frame in frames]).numpy()
        boxes = None if path is None else attempt(problems, lambda: read_boxes(path, np.array(frames), positions))
        if problems or calibration is None or stamps is None:
            raise LogError(problems)
        turn = _turn(lines, frames)
        unposed = frames[-1] - frames[0] + 1 - len(frames)
        return _Parts(frames, calibration, stamps, _path(poses, lines, frames, turn), turn, boxes, unposed)

    def _rig_camera(self, calibration: Calibration360, index: int, name: str) -> RigCamera[str]:
        camera = calibration.cameras[name]
        if isinstance(camera, FisheyeCamera):
            return lens_camera(
                name,
                index,
                lens=camera.lens,
                recorded_size=camera.size,
                width=self.width,
                pinhole_fov=self.pinhole_fov,
                undistort=self.undistort,
            )
        return self.pinhole(name, index, camera.intrinsics, camera.size)

    def _notes(self, sequence: SequenceFolders, parts: _Parts, num_labeled: int) -> tuple[str, ...]:
        notes = []
        if parts.num_unposed:
            notes.append(f"{parts.num_unposed} frames have no pose, as the car hardly moved, and are left out")
        without = sum(not sequence.sweep(frame).is_file() for frame in parts.frames)
        if self.lidar and sequence.lidar.is_dir() and without:
            notes.append(f"{without} of {len(parts.frames)} frames have no lidar file: they have no points")
        images = len(parts.frames) * len(sequence.cameras)
        if 0 < num_labeled < images:
            notes.append(f"{num_labeled} of {images} images have labels, those of image_00: the others have no masks")
        if len(parts.path.stamps) == 1 and self.lidar:
            notes.append("a single pose says nothing of the car's motion, which the points keep")
        return tuple(notes)


def _stamps(sequence: SequenceFolders, lines: list[int | None], frames: tuple[int, ...]) -> tuple[int, ...]:
    return increasing(at_frames(lines, frames), frames, sequence.stamps(sequence.cameras[0]))


def _turn(lines: list[int | None], frames: tuple[int, ...]) -> int:
    """The usual time from frame to frame: the lidar triggers the cameras once a turn."""
    near = at_frames(lines, range(max(frames[0] - 1, 0), frames[-1] + 2))
    steps = [after - before for before, after in pairwise(near) if before is not None and after is not None]
    usual = median_low(steps) if steps else _TURN
    return usual if 10_000_000 < usual < 1_000_000_000 else _TURN


def _path(
    poses: dict[int, Float64[Tensor, "4 4"]], lines: list[int | None], frames: tuple[int, ...], turn: int
) -> PosePath:
    """Poses of the frames, and of the last before and the first after them where these are sound and have stamps."""
    known = list(poses)
    first, last = known.index(frames[0]), known.index(frames[-1])
    stamps, taken = [], []
    for frame in known[max(first - 1, 0) : last + 2]:
        stamp = lines[frame] if frame < len(lines) else None
        sound = rigidity_error(poses[frame]) <= RIGIDITY_TOLERANCE
        if sound and stamp is not None and (not stamps or stamp > stamps[-1]):
            stamps.append(stamp)
            taken.append(poses[frame])
    return PosePath(torch.tensor(stamps), torch.stack(taken), max_extrapolation=turn)


def _shots(sequence: SequenceFolders, parts: _Parts) -> list[RecordedImage]:
    shots = []
    poses = parts.path.at(torch.tensor(parts.stamps))
    for place, frame in enumerate(parts.frames):
        for index, name in enumerate(sequence.cameras):
            pose = poses[place] @ parts.calibration.imu_from_camera[name]
            path = sequence.image(name, frame)
            shots.append(RecordedImage(place, index, pose, path, path.stem, parts.stamps[place]))
    return shots


def _sweeps(sequence: SequenceFolders, parts: _Parts) -> dict[int, LidarSweep]:
    poses = parts.path.at(torch.tensor(parts.stamps)) @ parts.calibration.imu_from_lidar
    return {
        place: LidarSweep(
            partial(_read_sweep, sequence, parts, place),
            parts.stamps[place],
            poses[place, :3, 3],
            partial(read_intensities, sequence.sweep(frame)),
        )
        for place, frame in enumerate(parts.frames)
        if sequence.sweep(frame).is_file()
    }


def _read_sweep(sequence: SequenceFolders, parts: _Parts, place: int) -> Float64[Tensor, "n 3"]:
    """Points in the world, each from where the car was when the turning lidar saw it."""
    points = read_points(sequence.sweep(parts.frames[place]))
    begin = parts.stamps[place] - parts.turn // 2
    stamps = point_stamps(points, begin, begin + parts.turn)
    return untwisted(transform_points(parts.calibration.imu_from_lidar, points), stamps, parts.path)


def _labeled(sequence: SequenceFolders, frames: tuple[int, ...]) -> set[tuple[str, Path]]:
    """Cameras and files of the images of labels that are there."""
    found = set()
    for camera in (name for name in sequence.cameras if name not in FISHEYE):
        folder = sequence.semantics(camera)
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        names = (f"{frame:010d}.png" for frame in frames)
        found |= {(camera, folder / name) for name in names if name in there}
    return found


def _labels(
    sequence: SequenceFolders,
    rig: tuple[RigCamera[str], ...],
    sizes: tuple[tuple[int, int], ...],
    labeled: set[tuple[str, Path]],
    shot: RecordedImage,
) -> Masks:
    camera = rig[shot.camera]
    path = sequence.semantics(camera.name) / f"{shot.stem}.png"
    return read_semantics(path, sizes[shot.camera], camera.size) if (camera.name, path) in labeled else {}
