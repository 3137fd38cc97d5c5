"""Objects and bodies of a log as the files of DriveStudio's layout have them."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Literal

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sparsestreet.data.drivestudio.bodies import blank_person, pickled_people, set_pose
from sparsestreet.data.drivestudio.layout import FLAVORS, UPRIGHT, Flavor
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.poses import AHEAD_FROM_OPENCV, PosePath
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.types import BodyPoses, Track, View

Role = Literal["vehicle", "cyclist", "pedestrian", "other"]

_NAMES: Mapping[Role, str] = {
    "vehicle": """vehicle car van truck bus tram train trolley caravan trailer motorcycle; unknown vehicle;
        vehicle.car; vehicle.truck; vehicle.bus.rigid; vehicle.bus.bendy; vehicle.trailer; vehicle.construction;
        vehicle.emergency.police; vehicle.emergency.ambulance; vehicle.motorcycle; regular_vehicle; large_vehicle;
        school_bus; articulated_bus; box_truck; truck_cab; vehicular_trailer; railed_vehicle; pickup truck;
        medium-sized truck; semi-truck; towed object; emergency vehicle; tram / subway;
        other vehicle - construction vehicle; other vehicle - uncommon""",
    "cyclist": "cyclist bicycle bicyclist motorcyclist rider; vehicle.bicycle; other vehicle - pedicab",
    "pedestrian": """pedestrian person; person (sitting); official_signaler; pedestrian with object;
        human.pedestrian.adult; human.pedestrian.child; human.pedestrian.construction_worker;
        human.pedestrian.police_officer""",
}
"""Lower case: single words up to the first semicolon, then one name between each two."""


def _table() -> dict[str, Role]:
    found: dict[str, Role] = {}
    for role, names in _NAMES.items():
        words, *others = names.split(";")
        found |= dict.fromkeys((*words.split(), *(" ".join(name.split()) for name in others)), role)
    return found


_ROLES = _table()


def role_of(class_name: str) -> Role:
    """``other`` for animals, strollers and whatever is not known.

    >>> role_of("REGULAR_VEHICLE"), role_of("human.pedestrian.adult"), role_of("Animals - Bird")
    ('vehicle', 'pedestrian', 'other')
    """
    return _ROLES.get(class_name.lower(), "other")


RIGID, BODY, DEFORMABLE = "RigidNodes", "SMPLNodes", "DeformableNodes"
"""The nodes that DriveStudio models an object by."""

KNOWN: Mapping[str, Mapping[str, str]] = {
    "waymo": {"Vehicle": RIGID, "Pedestrian": BODY, "Cyclist": DEFORMABLE},
    "nuscenes": {
        **dict.fromkeys(("vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction"), RIGID),
        **dict.fromkeys(("vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle"), RIGID),
        **dict.fromkeys(("vehicle.trailer", "vehicle.truck"), RIGID),
        **dict.fromkeys(("human.pedestrian.adult", "human.pedestrian.child"), BODY),
        **dict.fromkeys(("human.pedestrian.construction_worker", "human.pedestrian.police_officer"), BODY),
        **dict.fromkeys(("human.pedestrian.personal_mobility", "human.pedestrian.stroller"), DEFORMABLE),
        **dict.fromkeys(("human.pedestrian.wheelchair", "animal", "vehicle.bicycle"), DEFORMABLE),
    },
}
"""Flavor -> name -> node."""

_OF_ROLES: Mapping[str, Mapping[str, str]] = {
    "waymo": {"vehicle": "Vehicle", "cyclist": "Cyclist", "pedestrian": "Pedestrian"},
    "nuscenes": {"vehicle": "vehicle.car", "cyclist": "vehicle.bicycle", "pedestrian": "human.pedestrian.adult"},
}
_MOBILITY = ("wheeled_device", "wheeled_rider", "motorized scooter", "personal mobility device", "misc", "other")
_OTHERS = {
    **dict.fromkeys(_MOBILITY, "human.pedestrian.personal_mobility"),
    **dict.fromkeys(("dog", "animal", "animals - bird", "animals - other"), "animal"),
    **{name: f"human.pedestrian.{name}" for name in ("stroller", "wheelchair")},
}
"""Lower case; road users of the role "other" that nuScenes has a name for, or, of Misc and other, one of their node."""


def class_in(flavor: str, class_name: str) -> str | None:
    """Return the name by which a flavor's loader models an object as its class asks; None: of no road user known.

    The loader of Waymo knows no animals, strollers and the like: they deform, as its cyclists do.

    >>> class_in("nuscenes", "BOX_TRUCK"), class_in("waymo", "vehicle.truck"), class_in("waymo", "STROLLER")
    ('vehicle.car', 'Vehicle', 'Cyclist')
    >>> class_in("nuscenes", "STOP_SIGN")
    """
    if class_name in KNOWN[flavor]:
        return class_name
    if (role := role_of(class_name)) != "other":
        return _OF_ROLES[flavor][role]
    other = class_name if class_name in KNOWN["nuscenes"] else _OTHERS.get(class_name.lower())
    return other if flavor == "nuscenes" or other is None else "Cyclist"


def frame_stamps(log: DrivingLog) -> tuple[int, ...] | None:
    """Nanoseconds of each frame: of its sweep, where there is one, else of its earliest image; None without a clock."""
    if len(log.stamps) < log.num_frames:
        return None
    return tuple(log.sweeps.stamps.get(index, log.stamps[index]) for index in range(log.num_frames))


def box_stamps(log: DrivingLog, track: Track) -> Int64[Tensor, " f"] | None:
    """Nanoseconds of each box of an object; None where they are those of its frames, or the log has no clock.

    Normalized time is a line through the stamps of the views; doubles hold it to a nanosecond.
    """
    if track.times is None or not log.stamps:
        return None
    timed = [(view.stamp, view.time) for view in log.views if view.stamp is not None]
    (first, start), (last, end) = min(timed), max(timed)
    if first == last:  # one instant tells nothing of others
        return None
    since = ((track.times - start) * ((last - first) / (end - start))).round().long()
    return first + since


def seconds_lines(stamps: Sequence[int]) -> bytes:
    """Nanoseconds as decimal seconds, a line each, with all of their digits."""
    return "".join(f"{Decimal(stamp).scaleb(-9):.9f}\n" for stamp in stamps).encode()


WrittenFlavor = Literal["auto", "waymo", "nuscenes"]

CAMERAS = {
    "waymo": ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"),
    "nuscenes": ("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT", "CAM_BACK"),
}
"""The data sets' names of the cameras that DriveStudio knows, by its numbers (datasets/dataset_meta.py)."""
_RIGID = 0.05
"""Meters, and radians, by which a rigid camera may move in a vehicle whose poses come ten times a second."""
_ANY = 2**62


@dataclass(frozen=True)
class Placement:
    """All poses as they are written; the order of views is the log's."""

    flavor: Flavor
    cameras: tuple[int, ...]
    """DriveStudio's number of each camera of the log."""
    world_from_camera: Float64[Tensor, "v 4 4"]
    """With OpenCV's axes."""
    world_from_sweep: Float64[Tensor, "f 4 4"]
    """The frame that points are written in: of a mounted camera's flavor the vehicle, else one with the world's axes at
    the first camera of the instant, because a log does not know where its lidars are."""
    mounts: Float64[Tensor, "c 4 4"] | None
    """Of mounted cameras: vehicle_from_camera, with OpenCV's axes."""


def placed(log: DrivingLog, wanted: WrittenFlavor = "auto") -> Placement:
    """Return where a log is written; "auto" is waymo for what only Waymo's cameras and classes can be, else nuscenes.

    Raises ValueError where the flavor waymo is asked for, and cameras are not known to be rigid on a vehicle.
    """
    seen = torch.stack([dataset_from_camera(log, view) for view in log.views])
    if wanted == "nuscenes" or (wanted == "auto" and not _is_waymo(log)):
        return _with_own_poses(log, seen)
    found = _mounted(log, seen) if log.vehicle is not None else "the log does not tell where its vehicle was"
    if isinstance(found, Placement):
        return found
    if wanted == "auto":
        return _with_own_poses(log, seen)
    raise ValueError(
        f"flavor waymo has cameras that are rigid on a vehicle, but {found}: say flavor=nuscenes, which has a "
        "pose for each image"
    )


def dataset_from_camera(log: DrivingLog, view: View) -> Float64[Tensor, "4 4"]:
    """Return the pose of an image with OpenCV's axes, in the data set's own world."""
    return log.dataset_from_world @ inverse(view.camera.camera_from_world.double())


def _is_waymo(log: DrivingLog) -> bool:
    known = all(track.class_name in KNOWN["waymo"] for track in log.tracks)
    return known and log.vehicle is not None and _numbers(log, "waymo") is not None


def _with_own_poses(log: DrivingLog, seen: Float64[Tensor, "v 4 4"]) -> Placement:
    sweeps = torch.eye(4, dtype=torch.float64).repeat(log.num_frames, 1, 1)
    for view, pose in zip(reversed(log.views), seen.flip(0), strict=True):
        sweeps[view.indices[0], :3, 3] = pose[:3, 3]
    return Placement(FLAVORS["nuscenes"], _chosen_numbers(log, "nuscenes"), seen, sweeps, None)


def _mounted(log: DrivingLog, seen: Float64[Tensor, "v 4 4"]) -> Placement | str:
    """The placement, or what speaks against it."""
    indices = torch.tensor([view.indices for view in log.views])
    own = inverse(_vehicle(log, indices[:, 0], [view.stamp for view in log.views])) @ seen
    # Its middle image lies between poses of the vehicle, where the first and the last may lie beyond them.
    places = [torch.nonzero(indices[:, 1] == camera).flatten() for camera in range(log.num_cameras)]
    mounts = torch.stack([own[some[len(some) // 2]] for some in places])
    apart = (own - mounts[indices[:, 1]]).flatten(1).abs().amax(1)
    if float(apart.max()) > _RIGID:
        name = (log.camera_names or tuple(map(str, range(log.num_cameras))))[int(indices[apart.argmax(), 1])]
        return f"camera {name} moves by up to {float(apart.max()):.2g} (meters or radians) in its own"
    if float((mounts @ inverse(AHEAD_FROM_OPENCV))[:, 2, 2].min()) < UPRIGHT:
        return "a camera is not upright in its own"
    frames = torch.arange(log.num_frames)
    vehicle = _vehicle(log, frames, frame_stamps(log) or [None] * log.num_frames)
    poses = vehicle[indices[:, 0]] @ mounts[indices[:, 1]]
    return Placement(FLAVORS["waymo"], _chosen_numbers(log, "waymo"), poses, vehicle, mounts)


def _vehicle(log: DrivingLog, frames: Tensor, stamps: Sequence[int | None]) -> Float64[Tensor, "n 4 4"]:
    """world_from_vehicle at instants that belong to frames, in the data set's world."""
    assert log.vehicle is not None  # as the callers know
    poses, own = log.vehicle.poses, log.vehicle.stamps
    if own is None:
        return log.dataset_from_world @ poses[frames]
    path = PosePath(torch.tensor(own), log.dataset_from_world @ poses, _ANY)
    return path.at(torch.tensor([stamp for stamp in stamps if stamp is not None]))


def _chosen_numbers(log: DrivingLog, flavor: str) -> tuple[int, ...]:
    return _numbers(log, flavor) or tuple(range(log.num_cameras))


def _numbers(log: DrivingLog, flavor: str) -> tuple[int, ...] | None:
    """DriveStudio's, of cameras whose names are the flavor's, or numbers already; None: they are others."""
    names, known = log.camera_names, CAMERAS[flavor]
    if names and all(name in known for name in names):
        return tuple(map(known.index, names))
    if names and all(name.isascii() and name.isdigit() and str(int(name)) == name for name in names):
        return tuple(map(int, names))
    return None


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
