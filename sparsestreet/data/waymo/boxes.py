"""Boxes of the objects of a segment, each at the instant when it was where the box is.

A box encloses what the lidar saw, so it is of the instant when the beam crossed it. Some files add the box of the
instant when a camera read the column of its center (``camera_synced_box``), which fits the images better.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.poses import AHEAD_FROM_OPENCV
from sparsestreet.data.problems import fault
from sparsestreet.data.recording import Boxes
from sparsestreet.data.waymo.segment import CLASSES, REMEDY, BoxLabel, CameraCalibration, ImageMotion, Segment, crossing
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import distort
from sparsestreet.types import Shutter

_PER_SECOND = 1_000_000_000
SIDES: dict[int, Literal["top", "left", "bottom", "right"]] = {1: "top", 2: "left", 3: "bottom", 4: "right"}
"""Side of the image that is read first."""


def nanoseconds(seconds: float) -> int:
    """Exact: a product would round a double of 1.5e9 seconds once more."""
    whole = int(seconds)
    return whole * _PER_SECOND + round((seconds - whole) * _PER_SECOND)


def middle(motion: ImageMotion) -> int:
    """Nanoseconds at the middle of exposure and readout."""
    return (nanoseconds(motion.trigger) + nanoseconds(motion.readout_done)) // 2


def readout(motion: ImageMotion) -> int:
    """Nanoseconds from the first row or column to the last; what is left of the time is its exposure."""
    spent = nanoseconds(motion.readout_done) - nanoseconds(motion.trigger)
    return max(spent - round(motion.exposure * _PER_SECOND), 0)


def vehicle_at(motion: ImageMotion, stamp: int) -> Float64[Tensor, "4 4"]:
    """world_from_vehicle at an instant (nanoseconds) near the image's."""
    later = (stamp - nanoseconds(motion.pose_time)) / _PER_SECOND
    pose = motion.world_from_vehicle.clone()
    pose[:3, :3] = pose[:3, :3] @ quat.to_matrix(quat.from_rotation_vector(later * motion.angular))
    pose[:3, 3] += later * motion.linear
    return pose


def camera_at(motion: ImageMotion, camera: CameraCalibration, stamp: int) -> Float64[Tensor, "4 4"]:
    """world_from_camera with OpenCV's axes."""
    return vehicle_at(motion, stamp) @ camera.vehicle_from_camera @ AHEAD_FROM_OPENCV


def shutter(motion: ImageMotion, camera: CameraCalibration) -> Shutter | None:
    """The camera's motion while its image is read out; None where all pixels are read at once, or no order is known."""
    if camera.direction not in SIDES:
        return None
    duration = readout(motion) / _PER_SECOND
    vehicle, pose = vehicle_at(motion, middle(motion)), camera_at(motion, camera, middle(motion))
    # A mount turns with the vehicle: its own velocity is v + R (w x t).
    lever = vehicle[:3, :3] @ torch.linalg.cross(motion.angular, camera.vehicle_from_camera[:3, 3])
    camera_from_world = pose[:3, :3].T
    translation = camera_from_world @ (motion.linear + lever) * duration
    rotation = camera_from_world @ vehicle[:3, :3] @ motion.angular * duration
    return Shutter(translation.float(), rotation.float(), SIDES[camera.direction], duration)


_SIGN = 3
_NEAR = 0.2
"""Meters ahead of a camera that a box's center must be to be projected."""
_ROUNDS = 3
"""Each takes the error of the instant times the share of the readout by which the box moves on the image in it."""


@dataclass(frozen=True)
class _Placed:
    frame: int
    stamp: int
    pose: Float64[np.ndarray, "4 4"]
    size: tuple[float, ...]
    kind: int
    seen: bool


def read_boxes(segment: Segment, first: int) -> tuple[list[Boxes], tuple[str, ...]]:
    """Those of all frames, which are counted from ``first``, and what has to be said about them.

    Signs are left out: they stand still. Raises LogError for broken labels.
    """
    objects: dict[str, list[_Placed]] = defaultdict(list)
    signs: set[str] = set()
    late = 0
    for frame in range(len(segment.stamps)):
        images: Mapping[str, ImageMotion] | None = None
        pose = None
        for label in segment.boxes(frame):
            if label.kind == _SIGN:
                signs.add(label.name)
                continue
            if pose is None:
                pose, images = segment.world_from_vehicle(frame).numpy(), segment.images(frame)
            before, one = objects[label.name][-1:], _placed(segment, frame, label, pose, images or {})
            if before and before[0].frame == frame:
                raise fault(segment.box_file, f"frame {frame} has two boxes of the object {label.name}", REMEDY)
            if before and before[0].stamp >= one.stamp:
                late += 1
                continue
            objects[label.name].append(one)
    found = [_boxes(name, placed, segment, first) for name, placed in objects.items()]
    every = [one for placed in objects.values() for one in placed]
    return found, _notes(len(signs), sum(one.seen for one in every), len(every), late)


def _boxes(name: str, placed: Sequence[_Placed], segment: Segment, first: int) -> Boxes:
    return Boxes(
        name,
        CLASSES[placed[0].kind],
        np.array([one.frame - first for one in placed]),
        np.stack([one.pose for one in placed]),
        np.array([one.size for one in placed]),
        segment.box_file,
        tuple(one.stamp for one in placed),
    )


def _placed(
    segment: Segment,
    frame: int,
    label: BoxLabel,
    world_from_vehicle: Float64[np.ndarray, "4 4"],
    images: Mapping[str, ImageMotion],
) -> _Placed:
    motion = None if label.seen_by is None else images.get(label.seen_by)
    calibration = None if label.seen_by is None else segment.cameras.get(label.seen_by)
    if label.seen_box is not None and motion is not None and calibration is not None:
        pose = world_from_vehicle @ _pose(label.seen_box)
        stamp = reading(motion, calibration, pose[:3, 3])
        return _Placed(frame, stamp, pose, label.seen_box[3:6], label.kind, True)
    stamp = 1000 * segment.stamps[frame] + crossing(*label.box[:2])
    return _Placed(frame, stamp, world_from_vehicle @ _pose(label.box), label.box[3:6], label.kind, False)


def reading(motion: ImageMotion, camera: CameraCalibration, place: Float64[np.ndarray, "3"]) -> int:
    """Nanoseconds at which the camera reads the row or column that shows a place of the world.

    A place outside of the image is taken at its border, one behind the camera in the middle.
    """
    stamp, duration = middle(motion), readout(motion)
    f_u, f_v, c_u, c_v = camera.intrinsic[:4]
    lens = torch.tensor(camera.intrinsic[4:], dtype=torch.float64)
    point = torch.from_numpy(np.append(place, 1.0))
    at = stamp
    for _ in range(_ROUNDS if camera.direction in (1, 2, 3, 4) else 0):
        x, y, depth, _ = inverse(camera_at(motion, camera, at)) @ point
        if depth < _NEAR:
            return stamp
        u, v = distort(torch.stack((x / depth, y / depth)), lens).tolist()
        # Share of the readout after which the row or column is read, less a half.
        across, down = (f_u * u + c_u) / camera.size[0] - 0.5, (f_v * v + c_v) / camera.size[1] - 0.5
        share = {1: down, 2: across, 3: -down, 4: -across}[camera.direction]
        at = stamp + round(min(max(share, -0.5), 0.5) * duration)
    return at


def _pose(box: Sequence[float]) -> Float64[np.ndarray, "4 4"]:
    """vehicle_from_box."""
    c, s = np.cos(box[6]), np.sin(box[6])
    return np.array([[c, -s, 0, box[0]], [s, c, 0, box[1]], [0, 0, 1, box[2]], [0, 0, 0, 1.0]])


def _notes(signs: int, seen: int, count: int, late: int) -> tuple[str, ...]:
    notes = [f"{signs} signs are left out: they stand still, and become part of the background"] if signs else []
    if seen:
        notes.append(f"{seen} of {count} boxes are those of the instant when a camera saw the object, as labelled")
    if seen < count:
        notes.append(
            f"{count - seen} of {count} boxes are the lidar's, taken to be of the instant when the beam crossed them"
        )
    if late:
        notes.append(f"{late} boxes are left out: their instants do not come after those of the frames before")
    return tuple(notes)
