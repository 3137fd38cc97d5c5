"""Objects and bodies of a log as the files of DriveStudio's layout have them."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import blank_person, pickled_people, set_pose
from sparsestreet.data.drivestudio.classes import CLASS_NAMES
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.motion import PosePath
from sparsestreet.data.stamps import box_stamps, frame_stamps
from sparsestreet.geometry import quaternions as quat
from sparsestreet.types import BodyPoses, Track

ROUNDING = 1000
"""Nanoseconds by which stamps of one instant may differ: data sets count in microseconds."""


def object_keys(log: DrivingLog) -> dict[str, str]:
    """Name of an object -> its key, 0 to n - 1, by which DriveStudio counts; names that are so already stay."""
    names = [track.name for track in log.tracks]
    numbers = [str(number) for number in range(len(names))]
    return dict(zip(names, names if set(names) == set(numbers) else numbers, strict=True))


def instances_info(log: DrivingLog) -> bytes:
    """instances_info.json: the boxes by the key of their object."""
    keys = object_keys(log)
    return _json({keys[track.name]: _entry(log, track) for track in log.tracks})


def frame_instances(log: DrivingLog) -> bytes:
    """frame_instances.json: the keys of the objects of each frame."""
    keys, listed = object_keys(log), {str(frame): [] for frame in range(log.num_frames)}
    for track in log.tracks:
        for frame in track.frames.tolist():
            listed[str(frame)].append(int(keys[track.name]))
    return _json(listed)


def people(log: DrivingLog) -> bytes:
    """smpl.pkl: the bodies, each as the first camera sees it."""
    keys, found = object_keys(log), {}
    first = {view.frame_index: view.camera.camera_from_world.double() for view in reversed(log.views)}
    for track in log.tracks:
        if track.body is not None:
            found[int(keys[track.name])] = _person(track.body, track.frames.tolist(), first, log.num_frames)
    return pickled_people(found)


def boxes_at_frames(log: DrivingLog, track: Track) -> Float64[Tensor, "f 4 4"]:
    """The boxes of an object in the data set's world, at the stamps of their frames."""
    poses, late = log.dataset_from_world @ track.world_from_object, delay_of_boxes(log, track)
    stamps, frames = box_stamps(log, track), frame_stamps(log)
    if late <= ROUNDING or stamps is None or frames is None:
        return poses
    wanted = torch.tensor([frames[frame] for frame in track.frames.tolist()])
    return PosePath(stamps, poses, max_extrapolation=late).at(wanted)


def delay_of_boxes(log: DrivingLog, track: Track) -> int:
    """Nanoseconds between a box of an object and its frame, the most of all."""
    stamps, frames = box_stamps(log, track), frame_stamps(log)
    if stamps is None or frames is None:
        return 0
    return max(abs(stamp - frames[frame]) for stamp, frame in zip(stamps.tolist(), track.frames.tolist(), strict=True))


def _entry(log: DrivingLog, track: Track) -> dict[str, Any]:
    annotations = {
        "frame_idx": track.frames.tolist(),
        "obj_to_world": boxes_at_frames(log, track).tolist(),
        "box_size": [track.size.double().tolist()] * len(track.frames),
    }
    name = CLASS_NAMES.get(track.class_name, track.class_name)
    # Our reader and DriveStudio's pass over the fourth.
    return {
        "id": track.name,
        "class_name": name,
        "frame_annotations": annotations,
        "original_class_name": track.class_name,
    }


def _person(
    body: BodyPoses, frames: list[int], first: Mapping[int | None, Float64[Tensor, "4 4"]], num_frames: int
) -> dict[str, Any]:
    person = blank_person(num_frames)
    person["smpl"]["betas"][:] = body.shape.numpy()
    joints = quat.to_matrix(body.rotations.double())
    for row, frame in enumerate(frames):
        if body.valid[row]:
            joints[row, 0] = first[frame][:3, :3] @ joints[row, 0]
            set_pose(person, frame, joints[row].numpy(), 0)
    return person


def _json(content: Any) -> bytes:
    return json.dumps(content, indent=1).encode()
