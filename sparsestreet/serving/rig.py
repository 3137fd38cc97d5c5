"""The vehicle of a run: where its cameras sit on it, where it was, and the clock of its log. It needs no gRPC."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from sparsestreet.geometry.cameras import inverse
from sparsestreet.records.run import RigRecord
from sparsestreet.scene.edits.paths import along
from sparsestreet.scene.views import DEFAULT_FRAME_RATE, RecordedViews, seconds_of
from sparsestreet.types import Camera, View

Pose = Float64[np.ndarray, "4 4"]
"""a_from_b: the place of b in a, and how it is turned."""

DEFAULT_MOUNT = (1.5, 0.0, 1.6)
"""Meters ahead, left and up of the rear axle on the ground: about where a car's front camera is."""
BEYOND = 60.0
"""Seconds before the first and after the last image at which the street is still shown, as it was then."""
_MIN_UP = 0.5
"""Cosine between z and the first camera's upright below which z is not up."""


@dataclass(frozen=True)
class Clock:
    """Integer microseconds, as simulators count, for normalized time."""

    start: int
    """Of normalized time 0."""
    seconds: float
    """That normalized time 0 to 1 takes."""

    def time(self, microseconds: int) -> float:
        """Normalized time in [0, 1]; instants just beside the log are its first or last.

        Raises ValueError for an instant farther away, which is one of another clock.
        """
        after = (microseconds - self.start) / 1e6
        if not -BEYOND <= after <= self.seconds + BEYOND:
            raise ValueError(
                f"the log lasts from {self.start} to {self.microseconds(1.0)} us, got {microseconds} us: ask for "
                "instants of its clock, which get_available_trajectories tells"
            )
        return min(max(after / self.seconds, 0.0), 1.0) if self.seconds > 0 else 0.0

    def microseconds(self, time: float) -> int:
        return self.start + round(1e6 * self.seconds * time)


@dataclass(frozen=True)
class RigCamera:
    """One camera of the vehicle."""

    name: str
    index: int
    """Its number in the log."""
    camera: Camera
    """Its lens and its image; the pose is that of its first view."""
    rig_from_camera: Pose


@dataclass(frozen=True)
class Rig:
    """The vehicle: x ahead, y left, z up, the origin at the rear axle on the ground."""

    cameras: tuple[RigCamera, ...]
    times: tuple[float, ...]
    """Normalized, increasing."""
    poses: Float64[np.ndarray, "n 4 4"]
    """world_from_rig at these times."""
    clock: Clock
    dataset_from_world: Pose

    def at(self, time: float) -> Pose:
        """world_from_rig of the recorded drive; before and after it at its ends."""
        return along(self.times, self.poses, time)

    def camera(self, name: str) -> RigCamera:
        """Raise ValueError for a name that no camera has."""
        for one in self.cameras:
            if one.name == name:
                return one
        raise ValueError(f"there is no camera {name!r}, only {', '.join(one.name for one in self.cameras)}")

    def distance(self, view: View) -> float:
        """Return how far a view's camera is from the nearest that recorded at its time, meters."""
        vehicle, place = self.at(view.time), view.camera.position.cpu().double().numpy()
        recorded = [(vehicle @ one.rig_from_camera)[:3, 3] for one in self.cameras]
        return min(float(np.linalg.norm(place - one)) for one in recorded)

    def view(self, name: str, world_from_rig: Pose, microseconds: int) -> View:
        """What a camera sees of the street from a vehicle that stands there, all of its pixels at once."""
        one = self.camera(name)
        pose = inverse(torch.from_numpy(world_from_rig @ one.rig_from_camera)).float()
        still = Camera(pose, one.camera.intrinsics, one.camera.width, one.camera.height, one.camera.distortion)
        return View(still, self.clock.time(microseconds), None, one.index)


def rig_of(
    views: RecordedViews,
    record: RigRecord | None,
    *,
    mount: Sequence[float] | None = None,
    names: Sequence[str] | None = None,
    frame_rate: float | None = None,
) -> Rig:
    """The vehicle of a run.

    Args:
        views: of the run.
        record: what training knew of the vehicle; None: the run is older.
        mount: meters ahead, left and up of the first camera, where the log has no vehicle; None: as in most cars.
        names: of the cameras, in the order of their numbers; None: those of the log, else their numbers.
        frame_rate: frames a second of a log without a clock.

    Raises ValueError for names or a mount that do not fit.
    """
    first: dict[int, View] = {}
    for view in views.all:
        first.setdefault(view.indices[1], view)
    indices, clock = sorted(first), _clock(views, frame_rate)
    if record is not None and record.world_from_vehicle is not None and mount is None:
        times, poses = _recorded(views, record, clock)
    else:
        times, poses = _below_camera(views, indices[0], DEFAULT_MOUNT if mount is None else mount)
    known = list(record.camera_names) if record is not None and record.camera_names else None
    called = dict(zip(indices, _names(indices, names, known), strict=True))
    cameras = []
    for index in indices:
        rig_from_camera = np.linalg.inv(along(times, poses, first[index].time)) @ _pose(first[index])
        cameras.append(RigCamera(called[index], index, first[index].camera, rig_from_camera))
    shift = np.eye(4) if record is None else np.array(record.dataset_from_world)
    return Rig(tuple(cameras), times, poses, clock, shift)


def _names(indices: Sequence[int], names: Sequence[str] | None, known: Sequence[str] | None) -> list[str]:
    if names is not None:
        if len(names) != len(indices) or len(set(names)) != len(names) or not all(names):
            raise ValueError(f"names= has a name for each of the {len(indices)} cameras, got {', '.join(names)}")
        return list(names)
    return [str(index) if known is None else known[index] for index in indices]


def _clock(views: RecordedViews, frame_rate: float | None) -> Clock:
    seconds = seconds_of(views, frame_rate or views.frame_rate or DEFAULT_FRAME_RATE)
    with_stamp = [view for view in views.all if view.stamp is not None]
    start = 0
    if with_stamp:
        view = with_stamp[0]
        start = round((view.stamp or 0) / 1000 - 1e6 * seconds * view.time)
    # Microseconds of messages are not negative.
    return Clock(max(start, 0), seconds)


def _recorded(
    views: RecordedViews, record: RigRecord, clock: Clock
) -> tuple[tuple[float, ...], Float64[np.ndarray, "n 4 4"]]:
    """The vehicle at its own stamps, or at the first view of each of its frames."""
    assert record.world_from_vehicle is not None
    poses = np.array(record.world_from_vehicle)
    if record.vehicle_stamps is not None:
        after = (np.array(record.vehicle_stamps) / 1000 - clock.start) / 1e6
        return tuple((after / clock.seconds).tolist()) if clock.seconds > 0 else (0.0,), poses
    starts: dict[int, float] = {}
    for view in views.all:
        frame = view.indices[0]
        starts[frame] = min(starts.get(frame, view.time), view.time)
    frames = [frame for frame in sorted(starts) if frame < len(poses)]
    return tuple(starts[frame] for frame in frames), poses[frames]


def _below_camera(
    views: RecordedViews, camera: int, mount: Sequence[float]
) -> tuple[tuple[float, ...], Float64[np.ndarray, "n 4 4"]]:
    """The vehicle whose first camera is at ``mount``: level, and turned to where this camera looks."""
    if len(mount) != 3:
        raise ValueError(f"mount= is meters ahead, left and up, got {list(mount)}")
    own = [view for view in views.all if view.indices[1] == camera]
    poses = []
    for view in own:
        world_from_camera = _pose(view)
        if -world_from_camera[2, 1] < _MIN_UP:
            raise ValueError(
                "z of the world is not up, so nobody knows where the ground is: train on a log with the vehicle's poses"
            )
        ahead = world_from_camera[:2, 2] / np.linalg.norm(world_from_camera[:2, 2])
        pose = np.eye(4)
        pose[:2, :2] = [[ahead[0], -ahead[1]], [ahead[1], ahead[0]]]
        pose[:3, 3] = world_from_camera[:3, 3] - pose[:3, :3] @ np.array(mount, np.float64)
        poses.append(pose)
    return tuple(view.time for view in own), np.array(poses)


def _pose(view: View) -> Pose:
    return inverse(view.camera.camera_from_world.double()).numpy()
