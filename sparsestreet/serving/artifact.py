"""``street.usdz``: what AlpaSim loads of a scene beside its pictures, in a zip that is not compressed.

The drive of the vehicle and the instants of its images, the tracks of the objects, what the scene is called, and the
ground that its physics sets vehicles on. There is no map: scores of leaving the road need other sources.
"""

import json
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

import sparsestreet
from sparsestreet.atomic import atomic_file
from sparsestreet.geometry.meshes import ply_bytes
from sparsestreet.scene.edits import objects_of
from sparsestreet.scene.edits.ground import ground_mesh
from sparsestreet.scene.loaded_scene import check_numbers
from sparsestreet.scene.nodes.tracked import Tracked
from sparsestreet.scene.views import RecordedViews
from sparsestreet.serving.renderer import ServedScene, frame_from_box
from sparsestreet.serving.rig import Pose, Rig, RigCamera

DEFAULT_CAR = (4.8, 1.9, 1.6)
"""Length, width, height of the vehicle, meters; the rear axle is 1 m before its rear end."""
_REAR = 1.0
_MIN_FRAME_US = 1
"""AlpaSim asks for frames that end after they start."""
_LONGEST_SHUTTER_US = 50_000
"""That a simulation may ask for: AlpaSim's own are 15,000 to 30,000."""
_MIN_POSES = 4
"""Of a track: AlpaSim draws a spline through them. Objects seen less often stay as they were recorded."""
_MESHES = ("mesh.ply", "mesh_ground.ply")
"""Of the whole street, and of its ground: AlpaSim's physics reads one of them. Both are the ground."""
_WHEN = (1980, 1, 1, 0, 0, 0)
"""Of the files in the zip: equal scenes give equal bytes."""


@dataclass(frozen=True)
class Provenance:
    """What identifies the run."""

    version: str
    data_hash: str
    seed: int


def write_artifact(
    path: Path, served: ServedScene, views: RecordedViews, provenance: Provenance, car: Sequence[float] = DEFAULT_CAR
) -> dict[str, int]:
    """Write the whole file or nothing.

    Args:
        path: ends in .usdz.
        served: the scene; ``sparsestreet serve`` gives the pictures of it, by the same name.
        views: of its log.
        provenance: of its run.
        car: length, width and height of the vehicle, meters.

    Returns:
        How many ``poses``, ``cameras``, ``objects`` and ``ground vertices`` there are. Where nothing tells how high the
        ground is, there is no mesh.

    Raises ValueError for a drive that is too short to start in, a number that is none, or a car that is none.
    """
    if len(car) != 3 or min(car) <= 0:
        raise ValueError(f"car= is length, width and height in meters, got {list(car)}")
    if len(served.rig.times) < 2:
        raise ValueError("a drive has two instants or more, got one: train on more frames")
    check_numbers(served.stored.scene)
    tracks = _tracks(served)
    ground = ground_mesh(served.stored.scene, views.all)
    files: dict[str, str | bytes] = {
        "metadata.yaml": yaml.safe_dump(_metadata(served, provenance), sort_keys=False),
        "rig_trajectories.json": json.dumps(_trajectories(served, views, car), allow_nan=False),
        "sequence_tracks.json": json.dumps({served.name: tracks}, allow_nan=False),
    }
    if ground is not None:
        files |= dict.fromkeys(_MESHES, ply_bytes(ground.mesh))
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _WHEN), content)
    return {
        "poses": len(served.rig.times),
        "cameras": len(served.rig.cameras),
        "objects": len(tracks["tracks_data"]["tracks_id"]),
        "ground vertices": 0 if ground is None else len(ground.mesh.vertices),
    }


def _metadata(served: ServedScene, provenance: Provenance) -> dict[str, Any]:
    clock, names = served.rig.clock, [camera.name for camera in served.rig.cameras]
    identity = f"{served.name} {provenance.data_hash} {provenance.version} {provenance.seed}"
    return {
        "scene_id": served.name,
        "version_string": f"sparsestreet {sparsestreet.__version__}",
        "training_date": "",
        "dataset_hash": provenance.data_hash,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, identity)),
        "is_resumable": False,
        "sensors": {"camera_ids": names, "lidar_ids": []},
        "logger": {"name": None, "run_id": None, "run_url": None},
        "time_range": {"start": clock.microseconds(0.0) / 1e6, "end": clock.microseconds(1.0) / 1e6},
    }


def _trajectories(served: ServedScene, views: RecordedViews, car: Sequence[float]) -> dict[str, Any]:
    rig, (length, width, height) = served.rig, car
    cameras = {f"{camera.name}@{served.name}": camera for camera in rig.cameras}
    return {
        "world_to_nre": {"matrix": np.linalg.inv(rig.dataset_from_world).tolist()},
        "camera_calibrations": {key: {"logical_sensor_name": camera.name} for key, camera in cameras.items()},
        "rig_trajectories": [
            {
                "sequence_id": served.name,
                "T_rig_world_timestamps_us": [rig.clock.microseconds(time) for time in rig.times],
                "T_rig_worlds": rig.poses.tolist(),
                "cameras_frame_timestamps_us": {key: _frames(views, camera, rig) for key, camera in cameras.items()},
                "rig_bbox": {
                    "centroid": [length / 2 - _REAR, 0.0, height / 2],
                    "dim": [length, width, height],
                    "rot": [0.0, 0.0, 0.0],
                },
            }
        ],
    }


def _frames(views: RecordedViews, camera: RigCamera, rig: Rig) -> list[list[int]]:
    """Start and end of the readout of the images of a camera that AlpaSim may start with.

    It asks for a picture that ends when the first of them does, at poses of up to ``_LONGEST_SHUTTER_US`` before. Those
    that would need a pose before the first or after the last are left out: only recorded poses are written.
    """
    first, last = (rig.clock.microseconds(rig.times[index]) for index in (0, -1))
    frames = []
    for view in views.all:
        if view.indices[1] == camera.index:
            shutter = view.camera.shutter
            half = round(5e5 * shutter.seconds) if shutter is not None else 0
            middle = rig.clock.microseconds(view.time)
            end = middle + half
            if first + _LONGEST_SHUTTER_US <= end <= last:
                frames.append([min(middle - half, end - _MIN_FRAME_US), end])
    if not frames:
        raise ValueError(
            f"AlpaSim starts with an image {_LONGEST_SHUTTER_US // 1000} ms or more behind the first pose, and not "
            f"behind the last, which is {(last - first) / 1000:g} ms behind it: camera {camera.name} has none, "
            "train on more frames"
        )
    return sorted(frames)


def _tracks(served: ServedScene) -> dict[str, Any]:
    names, classes, stamps, poses, sizes = [], [], [], [], []
    for name, (_, node, instance) in objects_of(served.stored.scene).items():
        times = node.keyframe_times[instance][node.keyframe_valid[instance]].tolist()
        if len(times) < _MIN_POSES:
            continue
        names.append(name)
        classes.append(node.classes[instance] or "automobile")
        stamps.append([served.rig.clock.microseconds(time) for time in times])
        poses.append([_position_and_turn(box_center(node, instance, time)) for time in times])
        sizes.append([float(size) for size in node.sizes[instance]])
    return {
        "tracks_data": {
            "tracks_id": names,
            "tracks_label_class": classes,
            "tracks_flags": ["CONTROLLABLE"] * len(names),
            "tracks_timestamps_us": stamps,
            "tracks_poses": poses,
        },
        "cuboidtracks_data": {"cuboids_dims": sizes},
    }


def box_center(node: Tracked, instance: int, time: float) -> Pose:
    """world_from_box of an object at a time, upright: what a request would say of it to leave it where it is."""
    return node.object_frames(node.pose_at(time))[instance] @ np.linalg.inv(frame_from_box(node, instance))


def _position_and_turn(pose: Float64[np.ndarray, "4 4"]) -> list[float]:
    """x, y, z, then the quaternion x, y, z, w."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]
