"""From the files of a sequence to a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from torch import Tensor

from sparsestreet.data.ego import bottom_rows
from sparsestreet.data.extent import check_extent
from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import image_size, read_image
from sparsestreet.data.marks import Marks
from sparsestreet.data.pandaset.boxes import Objects, read_objects
from sparsestreet.data.pandaset.layout import CAMERA_FROM_LIDAR, EGO_ROWS, FRONT, USUAL_CAMERAS, Layout, find_sequence
from sparsestreet.data.pandaset.spin import Spin, spin_of
from sparsestreet.data.pandaset.tables import PER_SECOND, read_intrinsics, read_poses, read_returns, read_stamps
from sparsestreet.data.problems import LogError, Problem, fault, missing_files
from sparsestreet.data.recording import LidarSweep, RecordedImage, RecordedReader, Recording
from sparsestreet.data.rig import RigCamera
from sparsestreet.data.window import chosen_cameras, frame_window


@dataclass(frozen=True, kw_only=True)
class PandaSetReader(RecordedReader):
    """A sequence of PandaSet: 80 instants at 10 Hz, an image of each camera at each, the returns of both lidars.

    The stamp of an instant is that of the front camera, which is taken at the middle of the sweep. Cameras are taken
    as pinholes whose rows are exposed at once; the data set declares neither lens nor shutter.
    """

    marks = Marks(("camera/front_camera/poses.json",), depth=2)

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
        given = None if self.masks is None else GivenMasks(Path(self.masks))
        problems = _check_places(chosen, rig, shots, objects)
        if given is not None:
            problems += given.check((rig[shot.camera].name, shot.stem) for shot in shots)
        if problems:
            raise LogError(problems)
        ego = {"ego"} if EGO_ROWS.keys() & set(chosen.cameras) else set()
        return Recording(
            name=chosen.layout.root.resolve().name,
            rig=rig,
            shots=shots,
            read_image=partial(_read_image, rig),
            read_masks=partial(_read_masks, rig, given),
            mask_kinds=frozenset(ego).union(given.kinds if given else ()),
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
        size = image_size(chosen.layout.image(name, chosen.frames[0]))
        return self.pinhole(name, index, read_intrinsics(folder / "intrinsics.json"), size)

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
            index: LidarSweep(partial(_points, path, world_from_lidar[index]), stamps[index])
            for index, path in enumerate(paths)
        }
        first = read_returns(paths[0], world_from_lidar[0])
        sweeps[0] = LidarSweep(lambda: first.world, stamps[0])
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


def _read_image(rig: Sequence[RigCamera[str]], shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
    return read_image(Path(str(shot.key)), rig[shot.camera].size)


def _read_masks(
    rig: Sequence[RigCamera[str]], given: GivenMasks | None, shot: RecordedImage
) -> dict[str, Bool[Tensor, "h w"]]:
    """Rows of the own car, and what somebody made, which counts where both are."""
    camera = rig[shot.camera]
    own = {"ego": bottom_rows(camera.size, *EGO_ROWS[camera.name])} if camera.name in EGO_ROWS else {}
    if given is None:
        return own
    recorded = image_size(Path(str(shot.key)))
    return own | given.read(camera.name, shot.stem, recorded_size=recorded, size=camera.size)


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
