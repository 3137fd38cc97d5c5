"""A run that can be served: the street of ``tests/export``, with a clock, and requests for it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.cameras import inverse
from sparsestreet.scene.storage import load_scene, save_scene
from sparsestreet.scene.views import write_views
from sparsestreet.serving import wire
from sparsestreet.serving.cameras import camera_spec, pose_message
from sparsestreet.serving.renderer import RigOptions, ServedScene, open_run
from sparsestreet.types import Camera, View
from tests.export.street import stored_street, street_views

STEP_US, START_US = 250_000, 1_532_402_927_600_000
"""From frame to frame, and of the first one: the log has a clock, whose zero is far away."""


def timed_views(width: int = 48, height: int = 32) -> list[View]:
    return [
        replace(view, seconds=0.25 * view.indices[0], stamp=1000 * (START_US + STEP_US * view.indices[0]))
        for view in street_views(width, height)
    ]


def write_run(folder: Path) -> Path:
    """A folder as training leaves it, without a ``run.json``; its name is that of the folder."""
    save_scene(folder / "scene.safetensors", stored_street())
    write_views(folder / "views.json", timed_views(), [], frame_rate=4.0)
    return folder


def served(folder: Path) -> ServedScene:
    return open_run(write_run(folder), "street", load_scene, RigOptions())


def world_from_camera(camera: Camera) -> np.ndarray:
    return inverse(camera.camera_from_world.double()).numpy()


def request_for(view: View, scene: str = "street", **changes: Any) -> Any:
    """For what a recorded view sees, all pixels at once."""
    pose = pose_message(world_from_camera(view.camera))
    request = wire.kind("RGBRenderRequest")(
        scene_id=scene,
        resolution_h=view.camera.height,
        resolution_w=view.camera.width,
        camera_intrinsics=camera_spec(str(view.camera_index), view.camera),
        frame_start_us=START_US + STEP_US * (view.frame_index or 0),
        image_format=1,
    )
    request.frame_end_us = request.frame_start_us
    request.sensor_pose.start_pose.CopyFrom(pose)
    request.sensor_pose.end_pose.CopyFrom(pose)
    for name, value in changes.items():
        setattr(request, name, value)
    return request


def as_sent(view: View) -> View:
    """The view after its pose was a message: float32, as a quaternion. Written apart from the server."""
    pose = pose_message(world_from_camera(view.camera))
    sent = np.eye(4)
    sent[:3, :3] = Rotation.from_quat([pose.quat.x, pose.quat.y, pose.quat.z, pose.quat.w]).as_matrix()
    sent[:3, 3] = pose.vec.x, pose.vec.y, pose.vec.z
    camera = replace(view.camera, camera_from_world=inverse(torch.from_numpy(sent)).float())
    return View(camera, view.time, None, view.camera_index)


def place(request: Any, name: str, start: np.ndarray, end: np.ndarray | None = None) -> None:
    """Adds an object, whose box has its center there."""
    one = request.dynamic_objects.add(track_id=name)
    one.pose_pair.start_pose.CopyFrom(pose_message(start))
    one.pose_pair.end_pose.CopyFrom(pose_message(start if end is None else end))


def at(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:3, 3] = x, y, z
    return pose
