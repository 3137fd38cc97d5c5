"""Writes the common drive as a rig that somebody describes by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sparsestreet.geometry import quaternions as quat
from tests.data.plan import PER_SECOND, Plan, moved

COLUMNS = ["time", "x", "y", "z"]


def as_parts(pose: np.ndarray) -> dict[str, list[float]]:
    rotation = quat.from_matrix(torch.from_numpy(np.ascontiguousarray(pose[:3, :3]))).tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": rotation}


def write_rig(folder: Path, plan: Plan) -> dict[str, Any]:
    """Returns the JSON's content: images with their own stamps, sweeps with times, a moving box."""
    cameras = {}
    for camera in plan.cameras:
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
        lens = {"model": "pinhole", "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, "first_pixel": 0}
        mount = as_parts(camera.vehicle_from_camera)
        cameras[camera.name] = {"width": camera.width, "height": camera.height, "lens": lens}
        cameras[camera.name] |= {"vehicle_from_camera": mount}
    content = {
        "comment": "the common drive",
        "cameras": cameras,
        "lidar": {"vehicle_from_lidar": plan.vehicle_from_lidar.tolist(), "columns": COLUMNS},
        "frames": [_frame(folder, plan, frame) for frame in range(plan.num_frames)],
        "boxes": [_box(plan)],
    }
    write_json(folder, content)
    return content


def write_json(folder: Path, content: Any) -> None:
    (folder / "rig.json").write_text(json.dumps(content))


def _frame(folder: Path, plan: Plan, frame: int) -> dict[str, Any]:
    images = {}
    for camera in plan.cameras:
        (folder / camera.name).mkdir(exist_ok=True, parents=True)
        name = f"{camera.name}/{frame:03d}.png"
        Image.fromarray(plan.image(frame, camera)).save(folder / name)
        images[camera.name] = {"file": name, "stamp": plan.image_stamp(frame, camera)}
    stamp = int(plan.stamps[frame])
    points, stamps = plan.sweep(frame)
    rows = np.column_stack(((stamps - stamp) / PER_SECOND, points))
    (folder / "lidar").mkdir(exist_ok=True)
    np.save(folder / f"lidar/{frame:03d}.npy", rows)
    pose = as_parts(plan.world_from_vehicle(stamp))
    return {"stamp": stamp, "world_from_vehicle": pose, "images": images, "lidar": f"lidar/{frame:03d}.npy"}


def _box(plan: Plan) -> dict[str, Any]:
    places = [
        {"frame": frame, "world_from_box": plan.world_from_box(int(stamp)).tolist(), "stamp": int(stamp)}
        for frame, stamp in enumerate(plan.stamps)
    ]
    return {"name": plan.box_name, "class": "car", "size": list(plan.box_size), "at": places}


def in_lidar(plan: Plan, frame: int) -> np.ndarray:
    """The world's points in the lidar's frame at the stamp of the sweep: compensated."""
    world_from_lidar = plan.world_from_vehicle(int(plan.stamps[frame])) @ plan.vehicle_from_lidar
    return moved(np.linalg.inv(world_from_lidar), plan.world_points(frame))
