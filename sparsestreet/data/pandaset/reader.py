"""From the files of a sequence to a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.images import image_size
from sparsestreet.data.pandaset.tables import (
    CAMERA_FROM_LIDAR,
    EGO_ROWS,
    FRONT,
    PER_SECOND,
    USUAL_CAMERAS,
    Cuboids,
    Layout,
    find_sequence,
    read_cuboids,
    read_intrinsics,
    read_poses,
    read_returns,
    read_stamps,
)
from sparsestreet.data.poses import check_extent
from sparsestreet.data.problems import LogError, Problem, attempt, fault, missing_files
from sparsestreet.data.reader import FolderSignature, LogFiles, chosen_cameras, frame_window
from sparsestreet.data.recorded_images import Pixels, RecordedImage, lowest_rows
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera
from sparsestreet.geometry.cameras import inverse, transform_points

_SURE = 0.9
"""Mean length of the unit vectors whose direction is the phase, of 1 for a lidar that turns evenly."""


@dataclass(frozen=True)
class Spin:
    """An even turn of a lidar: azimuth over time."""

    period: float
    """Seconds."""
    direction: int
    """1: counterclockwise seen from above, -1: clockwise."""
    phase: float
    """Radians: 2 pi t / period = direction * azimuth + phase, but for whole turns."""
    middle: float
    """Seconds from the stamp of a sweep to the middle of its turn."""

    def passing(self, azimuths: np.ndarray) -> np.ndarray:
        """Seconds from the stamp of the sweep to the instants at which the beam has these azimuths (radians)."""
        since = self.direction * azimuths + self.phase - 2 * np.pi * self.middle / self.period
        return self.middle + self.period * ((since / (2 * np.pi) + 0.5) % 1 - 0.5)


def spin_of(azimuths: np.ndarray, seconds: np.ndarray, period: float) -> Spin | None:
    """The turn that returns show: which way, and when ahead; None where they show none.

    Args:
        azimuths: of the returns in the frame of the lidar, radians.
        seconds: from the stamp of the sweep to each return.
        period: seconds of a turn.
    """
    # Points of another data set, written in this one's layout, are where they were at one instant.
    if not len(azimuths) or seconds.min() == seconds.max():
        return None
    middle = (seconds.min() + seconds.max()) / 2
    turns = 2 * np.pi * seconds / period
    sums = {direction: np.exp(1j * (turns - direction * azimuths)).mean() for direction in (1, -1)}
    direction = max(sums, key=lambda one: abs(sums[one]))
    if abs(sums[direction]) < _SURE:
        return None
    return Spin(period, direction, float(np.angle(sums[direction])), float(middle))


@dataclass(frozen=True)
class Objects:
    """What the cuboids of a window are."""

    boxes: list[Boxes]
    stationary: int
    """How many objects stand through all of the scene."""
    twins: int
    """Cuboids left out because another is of the same object at the same instant."""
    crowded: int
    """Cuboids left out because the one before is not earlier."""


@dataclass(frozen=True)
class _Object:
    label: str
    stationary: bool
    frames: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    sizes: list[np.ndarray] = field(default_factory=list)


def read_objects(
    layout: Layout,
    frames: Sequence[int],
    stamps: Sequence[int],
    world_from_lidar: Float64[Tensor, "f 4 4"],
    spin: Spin | None,
) -> Objects:
    """The objects of a window; raises LogError with all files that are broken.

    Args:
        layout: the sequence.
        frames: of the window, as files are numbered.
        stamps: of the sweeps of the window.
        world_from_lidar: at these stamps.
        spin: when the lidar passed a direction, which is when a box was where it is; None: at the stamp of its sweep.
    """
    objects: dict[str, _Object] = {}
    problems: list[Problem] = []
    twins = crowded = 0
    for index, frame in enumerate(frames):
        cuboids = attempt(problems, partial(read_cuboids, layout.boxes(frame)))
        if cuboids is None:
            continue
        twins += cuboids.twins
        moments = stamps[index] + _delays(cuboids, world_from_lidar[index], spin)
        for row, name in enumerate(cuboids.names):
            one = objects.setdefault(name, _Object(cuboids.labels[row], bool(cuboids.stationary[row])))
            if one.stamps and moments[row] <= one.stamps[-1]:
                crowded += 1
                continue
            one.frames.append(index)
            one.stamps.append(int(moments[row]))
            one.poses.append(cuboids.poses[row])
            one.sizes.append(cuboids.sizes[row])
    if problems:
        raise LogError(problems)
    boxes = [
        Boxes(
            name=name,
            class_name=one.label,
            frames=np.array(one.frames),
            poses=np.stack(one.poses),
            sizes=np.stack(one.sizes),
            path=layout.cuboids,
            stamps=tuple(one.stamps),
        )
        for name, one in objects.items()
    ]
    return Objects(boxes, sum(one.stationary for one in objects.values()), twins, crowded)


def _delays(cuboids: Cuboids, world_from_lidar: Float64[Tensor, "4 4"], spin: Spin | None) -> np.ndarray:
    """Nanoseconds from the stamp of the sweep to the moment of each box; 0 for those of the other lidar."""
    if spin is None or not cuboids.names:
        return np.zeros(len(cuboids.names), dtype=np.int64)
    centers = transform_points(inverse(world_from_lidar), torch.from_numpy(cuboids.poses[:, :3, 3])).numpy()
    seconds = spin.passing(np.arctan2(centers[:, 1], centers[:, 0]))
    return np.where(cuboids.spinning, np.round(seconds * PER_SECOND), 0).astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class PandaSetReader(RecordedReader):
    """A sequence of PandaSet: 80 instants at 10 Hz, an image of each camera at each, the returns of both lidars.

    The stamp of an instant is that of the front camera, which is taken at the middle of the sweep. Cameras are taken
    as pinholes whose rows are exposed at once; the data set declares neither lens nor shutter.
    """

    marks = FolderSignature(("camera/front_camera/poses.json",), depth=2)

    scene: str | int | None = None
    """Name of the sequence, "001" or 1; None: the only one below the root."""

    def recording(self) -> Recording:
        chosen = self._selection()
        rig = [self._camera(chosen, name, index) for index, name in enumerate(chosen.cameras)]
        placed = {name: _placed(chosen, name) for name in {FRONT, *chosen.cameras}}
        window = slice(chosen.frames.start, chosen.frames.stop)
        stamps, front = placed[FRONT][0][window], placed[FRONT][1][window]
        world_from_lidar = front @ CAMERA_FROM_LIDAR
        shots = _shots(chosen, placed)
        sweeps, spin = self._sweeps(chosen, stamps, world_from_lidar)
        objects = self._objects(chosen, stamps, world_from_lidar, spin)
        problems = _check_places(chosen, rig, shots, objects)
        problems += self.given.check((rig[shot.camera].name, shot.stem) for shot in shots)
        if problems:
            raise LogError(problems)
        sizes = [_recorded_size(chosen, camera.name) for camera in rig]
        pixels = Pixels(rig, sizes, self.given, lowest_rows(rig, EGO_ROWS), "the first image of the camera is")
        return Recording(
            name=chosen.layout.root.resolve().name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=pixels.masks,
            mask_kinds=self.given.beside(["ego"] if EGO_ROWS.keys() & set(chosen.cameras) else ()),
            frame_stamps=tuple(stamps),
            sweeps=sweeps,
            boxes=None if objects is None else objects.boxes,
            notes=_notes(objects, spin, lidar=sweeps is not None),
        )

    def files(self) -> LogFiles:
        chosen = self._selection()
        layout = chosen.layout
        tables = [layout.camera(name) / file for name in {FRONT, *chosen.cameras} for file in _TABLES]
        boxes = [layout.boxes(frame) for frame in chosen.frames]
        images = [layout.image(name, frame) for name in chosen.cameras for frame in chosen.frames]
        points = [layout.sweep(frame) for frame in chosen.frames] if self.lidar and layout.lidar.is_dir() else []
        return LogFiles((*tables, *boxes), (*images, *points))

    def _selection(self) -> "_Selection":
        layout = find_sequence(self.folder, self.scene)
        stamps = read_stamps(layout.camera(FRONT) / "timestamps.json")
        frames = frame_window(len(stamps), self.first_frame, self.last_frame, layout.root)
        found = layout.cameras
        cameras = chosen_cameras(found, self.cameras or [name for name in USUAL_CAMERAS if name in found], layout.root)
        return _Selection(layout, cameras, frames, len(stamps))

    def _camera(self, chosen: "_Selection", name: str, index: int) -> RigCamera[str]:
        folder = chosen.layout.camera(name)
        if absent := missing_files(chosen.layout.image(name, frame) for frame in chosen.frames):
            raise LogError(absent)
        return self.pinhole(name, index, read_intrinsics(folder / "intrinsics.json"), _recorded_size(chosen, name))

    def _sweeps(
        self, chosen: "_Selection", stamps: Sequence[int], world_from_lidar: Float64[Tensor, "f 4 4"]
    ) -> tuple[dict[int, LidarSweep] | None, Spin | None]:
        """The sweeps, and the turn of the lidar as the first of them shows it; None where there is no lidar."""
        if not self.lidar or not chosen.layout.lidar.is_dir():
            return None, None
        paths = [chosen.layout.sweep(frame) for frame in chosen.frames]
        if absent := missing_files(paths):
            raise LogError(absent)
        sweeps = {
            index: LidarSweep(partial(_points, path, pose), stamps[index], pose[:3, 3])
            for index, (path, pose) in enumerate(zip(paths, world_from_lidar, strict=True))
        }
        first = read_returns(paths[0], world_from_lidar[0])
        sweeps[0] = LidarSweep(lambda: first.world, stamps[0], world_from_lidar[0, :3, 3])
        local = first.local.numpy()[first.spinning]
        seconds = first.seconds[first.spinning] - stamps[0] / PER_SECOND
        return sweeps, spin_of(np.arctan2(local[:, 1], local[:, 0]), seconds, _PERIOD)

    def _objects(
        self,
        chosen: "_Selection",
        stamps: Sequence[int],
        world_from_lidar: Float64[Tensor, "f 4 4"],
        spin: Spin | None,
    ) -> Objects | None:
        if not chosen.layout.cuboids.is_dir():
            return None
        if absent := missing_files(chosen.layout.boxes(frame) for frame in chosen.frames):
            raise LogError(absent)
        return read_objects(chosen.layout, chosen.frames, stamps, world_from_lidar, spin)


@dataclass(frozen=True)
class _Selection:
    """The part of a sequence that is read."""

    layout: Layout
    cameras: tuple[str, ...]
    frames: range
    """As files are numbered."""
    num_frames: int
    """Of the sequence."""


_TABLES = ("intrinsics.json", "poses.json", "timestamps.json")
_PERIOD = 0.1
"""Seconds of a turn of the lidar."""


def _placed(chosen: _Selection, name: str) -> tuple[list[int], Float64[Tensor, "n 4 4"]]:
    """Stamps and poses of all images of a camera; raises LogError for another number than the sequence has."""
    folder = chosen.layout.camera(name)
    stamps, poses = read_stamps(folder / "timestamps.json"), read_poses(folder / "poses.json")
    for file, found in (("timestamps.json", len(stamps)), ("poses.json", len(poses))):
        if found != chosen.num_frames:
            message = f"it has {found} entries, the front camera has {chosen.num_frames} stamps"
            raise fault(folder / file, message, "fetch the files of all cameras again")
    return stamps, poses


def _shots(chosen: _Selection, placed: Mapping[str, tuple[list[int], Float64[Tensor, "n 4 4"]]]) -> list[RecordedImage]:
    return [
        RecordedImage(
            frame=index,
            camera=camera,
            world_from_camera=placed[name][1][frame],
            key=chosen.layout.image(name, frame),
            stem=f"{frame:02d}",
            stamp=placed[name][0][frame],
        )
        for index, frame in enumerate(chosen.frames)
        for camera, name in enumerate(chosen.cameras)
    ]


def _check_places(
    chosen: _Selection, rig: Sequence[RigCamera[str]], shots: Sequence[RecordedImage], objects: Objects | None
) -> list[Problem]:
    """Whether images and boxes lie within one scene."""
    placed = [
        (chosen.layout.camera(rig[one.camera].name) / "poses.json", one.world_from_camera[:3, 3]) for one in shots
    ]
    for boxes in objects.boxes if objects else ():
        placed += [(boxes.path, position) for position in torch.from_numpy(boxes.poses[:, :3, 3])]
    return check_extent(placed)


def _points(path: Path, world_from_lidar: Float64[Tensor, "4 4"]) -> Float64[Tensor, "n 3"]:
    return read_returns(path, world_from_lidar).world


def _recorded_size(chosen: "_Selection", camera: str) -> tuple[int, int]:
    """(width, height) of the first image that is read, pixels: the data set does not tell."""
    return image_size(chosen.layout.image(camera, chosen.frames[0]))


def _notes(objects: Objects | None, spin: Spin | None, *, lidar: bool) -> tuple[str, ...]:
    """What a user should know about how it was read."""
    notes = [
        "images seem to be read row by row, which the data set does not declare: all rows are taken at the stamp",
        "the calibration names no lens: cameras are pinholes, although their images are slightly distorted",
    ]
    if lidar:
        notes.append("returns stand where the files have them; how well the car's motion is taken out is not known")
    if objects is None:
        return tuple(notes)
    if spin is None:
        notes.append("boxes have the stamps of their sweeps: no returns tell when the lidar passed them")
    counted = {
        f"{objects.stationary} of {len(objects.boxes)} objects are marked as standing all the time": objects.stationary,
        f"{objects.twins} boxes of the lidar that looks ahead are left out: the other lidar saw the same objects": (
            objects.twins
        ),
        f"{objects.crowded} boxes are left out: the lidar passed them no later than the ones before": objects.crowded,
    }
    return (*notes, *(sentence for sentence, count in counted.items() if count))
