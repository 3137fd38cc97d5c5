"""Views, objects and pixels of the part of a rig's recording that is read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from sparsestreet.data.given_masks import GivenMasks
from sparsestreet.data.images import read_image, read_mask
from sparsestreet.data.motion import PosePath
from sparsestreet.data.recording import Boxes, LidarSweep, RecordedImage
from sparsestreet.data.rig import RigCamera
from sparsestreet.data.rig_json.sweeps import read_sweep
from sparsestreet.data.rig_json.table import CameraEntry, FrameEntry, ImageEntry, RigTable
from sparsestreet.types import Shutter

_PER_SECOND = 1e9


@dataclass(frozen=True)
class Part:
    """The chosen cameras and frames of a table."""

    table: RigTable
    cameras: Sequence[str]
    places: Sequence[int]
    """Of the frames in the table: those of the window with an image of these cameras."""

    @property
    def frames(self) -> list[FrameEntry]:
        return [self.table.frames[place] for place in self.places]

    @property
    def stamps(self) -> tuple[int, ...] | None:
        """None: there is no clock."""
        return tuple(frame.stamp for frame in self.frames if frame.stamp is not None) or None

    @property
    def vehicle(self) -> PosePath | None:
        """At the frames of the window; None: without a clock, or without poses."""
        return _drive(self.frames)

    def shots(self) -> list[RecordedImage]:
        drive = _drive(self.table.frames)
        return [
            _shot(self.table, drive, entry, frame, index, name)
            for frame, entry in enumerate(self.frames)
            for index, name in enumerate(self.cameras)
            if name in entry.images
        ]

    def sweeps(self, shots: Sequence[RecordedImage]) -> dict[int, LidarSweep] | None:
        """Of the frames that have one; None: no frame of the table has."""
        if not any(frame.sweep for frame in self.table.frames):
            return None
        drive = _drive(self.table.frames)
        near = {shot.frame: shot.world_from_camera[:3, 3] for shot in reversed(shots)}
        sweeps = {}
        for index, frame in enumerate(self.frames):
            if frame.sweep is not None:
                stamp = frame.stamp if frame.sweep_stamp is None else frame.sweep_stamp
                reference = near[index] if frame.world_from_vehicle is None else frame.world_from_vehicle[:3, 3]
                read = partial(read_sweep, frame.sweep, frame, self.table.lidar, drive, reference)
                sweeps[index] = LidarSweep(read, stamp)
        return sweeps

    def boxes(self) -> list[Boxes] | None:
        """Objects with a box in these frames, in their count."""
        if self.table.boxes is None:
            return None
        index = {place: index for index, place in enumerate(self.places)}
        found = []
        for box in self.table.boxes:
            rows = [row for row, place in enumerate(box.frames.tolist()) if place in index]
            if rows:
                frames = np.array([index[place] for place in box.frames[rows].tolist()])
                stamps = None if box.stamps is None else tuple(box.stamps[row] for row in rows)
                found.append(replace(box, frames=frames, poses=box.poses[rows], sizes=box.sizes[rows], stamps=stamps))
        return found


def _shot(
    table: RigTable, drive: PosePath | None, entry: FrameEntry, frame: int, index: int, name: str
) -> RecordedImage:
    image, mount = entry.images[name], table.cameras[name].vehicle_from_camera
    stamp = entry.stamp if image.stamp is None else image.stamp
    pose = image.world_from_camera
    if pose is None:
        if mount is None or entry.world_from_vehicle is None:
            raise image.where.fault("has no pose", "write world_from_camera")  # read_table has looked
        pose = entry.world_from_vehicle @ mount
        if stamp is not None and stamp != entry.stamp and drive is not None:
            try:
                pose = drive.at(torch.tensor([stamp]))[0] @ mount
            except ValueError as error:
                remedy = "give the image its own world_from_camera, or the frames poses around it"
                raise image.where.fault(f"has no pose: {error}", remedy) from error
    shutter = _shutter(table.cameras[name], drive, image, stamp)
    exposure = table.cameras[name].exposure
    return RecordedImage(frame, index, pose, image, image.path.stem, stamp, shutter, exposure)


def _shutter(camera: CameraEntry, drive: PosePath | None, image: ImageEntry, stamp: int | None) -> Shutter | None:
    """The camera's motion on the vehicle's path while the image is read out; None: it is exposed at once."""
    if not camera.readout:
        return None
    if drive is None or stamp is None or camera.vehicle_from_camera is None:
        remedy = "write stamps and world_from_vehicle of the frames and the camera's mount, or leave out its shutter"
        raise image.where.fault("has a shutter, but nothing tells how the camera moves", remedy)
    path = replace(drive, poses=drive.poses @ camera.vehicle_from_camera)
    try:
        return Shutter(*path.motion_during(stamp, camera.readout), camera.side, camera.readout / _PER_SECOND)
    except ValueError as error:
        remedy = "give the frames poses around it, or leave the image out"
        raise image.where.fault(f"is read out where no pose is known: {error}", remedy) from error


def _drive(frames: Sequence[FrameEntry]) -> PosePath | None:
    """Where the vehicle is over time, and a frame's step beyond; None: without a clock, or without poses."""
    known = [
        (frame.stamp, frame.world_from_vehicle)
        for frame in frames
        if frame.stamp is not None and frame.world_from_vehicle is not None
    ]
    if not known:
        return None
    stamps = [stamp for stamp, _ in known]
    step = (stamps[-1] - stamps[0]) // max(len(stamps) - 1, 1)
    return PosePath(torch.tensor(stamps), torch.stack([pose for _, pose in known]), max_extrapolation=step)


def read_pixels(rig: Sequence[RigCamera[str]], shot: RecordedImage) -> UInt8[Tensor, "h w 3"]:
    camera = rig[shot.camera]
    return read_image(entry_of(shot).path, camera.size, camera.undistortion)


def read_masks(
    table: RigTable, rig: Sequence[RigCamera[str]], given: GivenMasks | None, shot: RecordedImage
) -> dict[str, Bool[Tensor, "h w"]]:
    camera = rig[shot.camera]
    entry, lens = table.cameras[camera.name], camera.undistortion
    masks: dict[str, Bool[Tensor, "h w"]] = {}
    if given is not None:
        masks = given.read(camera.name, shot.stem, recorded_size=entry.size, size=camera.size, undistortion=lens)
    if entry.ego_mask is not None:
        ego = read_mask(entry.ego_mask, camera.size, sky=False, undistortion=lens)
        masks["ego"] = masks["ego"] | ego if "ego" in masks else ego
    return masks


def entry_of(shot: RecordedImage) -> ImageEntry:
    assert isinstance(shot.key, ImageEntry)
    return shot.key
