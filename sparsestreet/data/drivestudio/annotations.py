"""Objects and bodies of a log as the files of DriveStudio's layout have them."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import blank_person, pickled_people, set_pose
from sparsestreet.data.drivestudio.classes import class_in
from sparsestreet.data.drivestudio.placement import Placement
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.motion import PosePath
from sparsestreet.data.stamps import box_stamps, frame_stamps
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import BodyPoses, Track

ROUNDING = 1000
"""Nanoseconds by which stamps of one instant may differ: data sets count in microseconds."""


def written_tracks(log: DrivingLog, flavor: str) -> list[Track]:
    """The objects whose class the flavor's loader has a name for."""
    return [track for track in log.tracks if class_in(flavor, track.class_name) is not None]


def object_keys(tracks: Sequence[Track]) -> dict[str, str]:
    """Name of an object -> its key, 0 to n - 1, by which DriveStudio counts; names that are so already stay."""
    names = [track.name for track in tracks]
    numbers = [str(number) for number in range(len(names))]
    return dict(zip(names, names if set(names) == set(numbers) else numbers, strict=True))


def instances_info(log: DrivingLog, flavor: str) -> bytes:
    """instances_info.json: the boxes by the key of their object."""
    tracks = written_tracks(log, flavor)
    keys = object_keys(tracks)
    return _json({keys[track.name]: _entry(log, track, flavor) for track in tracks})


def frame_instances(log: DrivingLog, flavor: str) -> bytes:
    """frame_instances.json: the keys of the objects of each frame; DriveStudio counts frames by these lists."""
    tracks, listed = written_tracks(log, flavor), {str(frame): [] for frame in range(log.num_frames)}
    keys = object_keys(tracks)
    for track in tracks:
        for frame in track.frames.tolist():
            listed[str(frame)].append(int(keys[track.name]))
    return _json(listed)


def people(log: DrivingLog, placement: Placement) -> bytes:
    """smpl.pkl: the bodies, each as the first camera sees it from where it is written."""
    tracks, found = written_tracks(log, placement.flavor.name), {}
    keys, turns = object_keys(tracks), log.dataset_from_world[:3, :3]
    first = {
        view.indices[0]: (placement.cameras[view.indices[1]], inverse(pose)[:3, :3] @ turns)
        for view, pose in zip(reversed(log.views), placement.world_from_camera.flip(0), strict=True)
    }
    for track in tracks:
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


def _entry(log: DrivingLog, track: Track, flavor: str) -> dict[str, Any]:
    annotations = {
        "frame_idx": track.frames.tolist(),
        "obj_to_world": boxes_at_frames(log, track).tolist(),
        "box_size": [track.size.double().tolist()] * len(track.frames),
    }
    # Our reader and DriveStudio's pass over the fourth.
    return {
        "id": track.name,
        "class_name": class_in(flavor, track.class_name),
        "frame_annotations": annotations,
        "original_class_name": track.class_name,
    }


def _person(
    body: BodyPoses, frames: list[int], first: Mapping[int, tuple[int, Float64[Tensor, "3 3"]]], num_frames: int
) -> dict[str, Any]:
    """``first``: frame -> number of its first camera, and how that is turned: camera_from_world of the log's world."""
    person = blank_person(num_frames)
    person["smpl"]["betas"][:] = body.shape.numpy()
    joints = quat.to_matrix(body.rotations.double())
    for row, frame in enumerate(frames):
        if body.valid[row]:
            camera, turn = first[frame]
            joints[row, 0] = turn @ joints[row, 0]
            set_pose(person, frame, joints[row].numpy(), camera)
    return person


def _json(content: Any) -> bytes:
    return json.dumps(content, indent=1).encode()
