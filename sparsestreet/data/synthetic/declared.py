"""What a street declares of its cameras and DriveStudio's layout has no room for: exposure, readout and motion."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic.cameras import street_camera
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.world import World
from sparsestreet.types import Shutter, View

_FILE = "cameras.json"
AnyView = TypeVar("AnyView", bound=View)


def write_declared(settings: StreetSettings, world: World, root: Path) -> None:
    """Writes the file if the settings have something to declare, and let it be known."""
    said: dict[str, Any] = {}
    if settings.readout and settings.readout_known:
        cameras, frames = range(settings.num_cameras), range(settings.num_frames)
        motion = [[_motion(settings, world, frame, camera) for frame in frames] for camera in cameras]
        said |= {"readout": settings.readout, "direction": settings.readout_direction, "motion": motion}
    if settings.shutter_time and settings.shutter_time_known:
        said["exposure"] = settings.shutter_time
    if said:
        (root / _FILE).write_text(json.dumps(said))


def with_declared(log: DrivingLog, settings: StreetSettings, root: Path) -> DrivingLog:
    """Returns the log whose views have what the street's file declares; the log itself if there is none."""
    path = root / _FILE
    if not path.is_file():
        return log
    said = json.loads(path.read_text())
    first, last = settings.recorded

    def shutter(frame: int, camera: int) -> Shutter:
        numbers, seconds = torch.tensor(said["motion"][camera][frame]), said["readout"]
        span = seconds / (last - first) if last > first else 0.0
        return Shutter(numbers[:3], numbers[3:], said["direction"], seconds, span)

    def told(view: AnyView) -> AnyView:
        read = shutter(*view.indices) if "readout" in said else None
        return replace(view, camera=replace(view.camera, shutter=read, exposure=said.get("exposure", 0.0)))

    def all_told(frames: Frames) -> Frames:
        return Frames(map(told, frames.views), lambda view: told(frames.load(view)))

    def carried_without(held_out: frozenset[int]) -> tuple[Frames, Sweeps]:
        kept = log.holding_out(held_out)
        return all_told(kept.frames), kept.sweeps

    return replace(log, frames=all_told(log.frames), carried_without=carried_without)


def _motion(settings: StreetSettings, world: World, frame: int, camera: int) -> list[float]:
    """Returns translation (meters) and rotation vector (radians) over the readout, as ``Shutter`` has them."""
    middle = settings.image_time(frame, camera)
    times = (middle - settings.readout / 2, middle, middle + settings.readout / 2)
    start, pose, end = (street_camera(settings, camera, world.ego.pose(time)).world_from_camera for time in times)
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate((pose[:3, :3].T @ (end[:3, 3] - start[:3, 3]), pose[:3, :3].T @ turn)).tolist()
