"""One genuine keyframe, which ships with a summary alone, behind tables that are made from it."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from sparsestreet.geometry.quaternions import from_rotation_vector, to_matrix
from sparsestreet.pickles import read_pickled
from tests.data.nuscenes.written import TABLES, Tables, Written, placed, token


def summary_of(folder: Path) -> dict[str, Any]:
    """Written by mmdetection3d, version 1.1; read without running anything in it."""
    (path,) = folder.glob("*.pkl")
    return read_pickled(path)["data_list"][0]


def world_from_box(summary: dict[str, Any], box: list[float]) -> np.ndarray:
    """Of center, length, width, height, yaw in the frame of the lidar."""
    pose = np.eye(4)
    pose[:3, :3] = to_matrix(from_rotation_vector(torch.tensor([0, 0, box[6]], dtype=torch.float64))).numpy()
    pose[:3, 3] = box[:3]
    return world_from_lidar(summary) @ pose


def world_from_lidar(summary: dict[str, Any]) -> np.ndarray:
    return rigid(summary["ego2global"]) @ rigid(summary["lidar_points"]["lidar2ego"])


def rigid(matrix: list[list[float]]) -> np.ndarray:
    """The summary's matrices went through float32: made rotations again."""
    pose = np.array(matrix, float)
    u, _, v = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ v
    return pose


def write_keyframe(folder: Path, root: Path) -> Written:
    """Links to the six images and the sweep, and tables of one sample."""
    summary = summary_of(folder)
    tables: Tables = {name: [] for name in TABLES}
    sample = {"token": summary["token"], "timestamp": round(1e6 * summary["timestamp"]), "scene_token": "s"}
    tables["sample"] = [sample | {"prev": "", "next": ""}]
    ends = {"first_sample_token": sample["token"], "last_sample_token": sample["token"], "nbr_samples": 1}
    tables["scene"] = [{"token": "s", "name": "scene-0061", "log_token": "", "description": ""} | ends]
    lidar = world_from_lidar(summary)
    sensors: dict[str, tuple[str, np.ndarray, np.ndarray, Any]] = {
        channel: (
            image["img_path"],
            rigid(image["cam2ego"]),
            lidar @ np.linalg.inv(rigid(image["lidar2cam"])),
            np.array(image["cam2img"])[:3, :3].tolist(),
        )
        for channel, image in summary["images"].items()
    }
    points = summary["lidar_points"]
    sensors["LIDAR_TOP"] = points["lidar_path"], rigid(points["lidar2ego"]), lidar, []
    for channel, (file, mount, pose, intrinsics) in sensors.items():
        _add_file(folder, root, tables, summary["token"], channel, file, mount, pose, intrinsics)
    _add_boxes(summary, tables)
    written = Written(root)
    written.table("scene").parent.mkdir(parents=True)
    for name, rows in tables.items():
        written.write(name, rows)
    return written


def _add_file(
    folder: Path,
    root: Path,
    tables: Tables,
    sample: str,
    channel: str,
    name: str,
    mount: Any,
    pose: Any,
    intrinsics: Any,
) -> None:
    path = root / "samples" / channel / name
    path.parent.mkdir(parents=True)
    path.symlink_to(folder / name)
    camera = channel != "LIDAR_TOP"
    modality = "camera" if camera else "lidar"
    tables["sensor"].append({"token": channel, "channel": channel, "modality": modality})
    tables["calibrated_sensor"].append(
        {"token": channel, "sensor_token": channel, "camera_intrinsic": intrinsics} | placed(mount)
    )
    # world_from_camera = world_from_ego after ego_from_camera
    tables["ego_pose"].append({"token": channel, "timestamp": 0} | placed(pose @ np.linalg.inv(mount)))
    stamp = int(path.name.split("__")[2].split(".")[0])
    tables["sample_data"].append(
        {
            "token": channel, "sample_token": sample, "ego_pose_token": channel, "calibrated_sensor_token": channel,
            "timestamp": stamp, "fileformat": "jpg" if camera else "pcd", "is_key_frame": True,
            "height": 900 if camera else 0, "width": 1600 if camera else 0, "prev": "", "next": "",
            "filename": path.relative_to(root).as_posix(),
        }
    )  # fmt: skip


def _add_boxes(summary: dict[str, Any], tables: Tables) -> None:
    tables["category"] = [{"token": "c", "name": "vehicle.car", "description": ""}]
    for number, one in enumerate(summary["instances"]):
        length, width, height = one["bbox_3d"][3:6]
        tables["instance"].append({"token": token(number), "category_token": "c"})
        tables["sample_annotation"].append(
            {
                "token": token(number), "sample_token": summary["token"], "instance_token": token(number),
                "size": [width, length, height], "attribute_tokens": [], "visibility_token": "",
                "num_lidar_pts": int(one["num_lidar_pts"]), "num_radar_pts": int(one["num_radar_pts"]),
                "prev": "", "next": "",
            }
            | placed(world_from_box(summary, one["bbox_3d"]))
        )  # fmt: skip
