"""The drive of the plan as nuScenes publishes one: thirteen tables, images, sweeps."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sparsestreet.geometry import quaternions as quat
from tests.data.plan import Plan, levels, moved

TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
Tables = dict[str, list[dict[str, Any]]]
CHANNELS = {"front": "CAM_FRONT", "left": "CAM_FRONT_LEFT"}


def token(*parts: object) -> str:
    return hashlib.md5(repr(parts).encode()).hexdigest()


def placed(transform: np.ndarray) -> dict[str, Any]:
    rotation = quat.from_matrix(torch.from_numpy(np.array(transform[:3, :3])))
    return {"translation": transform[:3, 3].tolist(), "rotation": rotation.tolist()}


def sweep_end(plan: Plan, frame: int) -> int:
    """The stamp of a sweep: when the turn ends whose middle is the stamp of the frame."""
    return int(plan.stamps[frame]) + plan.period // 2


@dataclass(frozen=True)
class Written:
    """A folder that was written, and how to change a table of it."""

    root: Path
    version: str = "v1.0-mini"

    def table(self, name: str) -> Path:
        return self.root / self.version / f"{name}.json"

    def rows(self, name: str) -> list[dict[str, Any]]:
        return json.loads(self.table(name).read_text())

    def write(self, name: str, rows: object) -> None:
        # As published: each key and each number on a line of its own.
        self.table(name).write_text(json.dumps(rows, indent=0))

    def edit(self, name: str, change: Callable[[list[dict[str, Any]]], object]) -> None:
        rows = self.rows(name)
        change(rows)
        self.write(name, rows)

    def file(self, channel: str, place: int = 0) -> Path:
        names = sorted(row["filename"] for row in self.rows("sample_data") if f"/{channel}/" in row["filename"])
        return self.root / names[place]


def write_nuscenes(root: Path, plan: Plan, *, keyframe_every: int = 1, scene: str = "scene-0061") -> Written:
    """Frames are keyframes, or each ``keyframe_every``-th; the frames behind one belong to the next, or to the last."""
    keyframes = list(range(0, plan.num_frames, keyframe_every))
    samples = [token("sample", scene, frame) for frame in keyframes]
    tables: Tables = {name: [] for name in TABLES}
    _write_scene(root, plan, scene, samples, keyframes, tables)
    _write_sensors(plan, tables)
    for channel in (*CHANNELS.values(), "LIDAR_TOP"):
        files = [token("file", scene, channel, frame) for frame in range(plan.num_frames)]
        for frame in range(plan.num_frames):
            key = frame in keyframes
            sample = samples[min(-(-frame // keyframe_every), len(samples) - 1)]
            tables["sample_data"].append(
                {"token": files[frame], "sample_token": sample, "ego_pose_token": files[frame]}
                | _write_file(root, plan, channel, frame, "samples" if key else "sweeps")
                | {"calibrated_sensor_token": token("mount", channel), "is_key_frame": key}
                | linked(files, frame)
            )
    for row in tables["sample_data"]:
        ego = placed(plan.world_from_vehicle(1000 * row["timestamp"]))
        tables["ego_pose"].append({"token": row["token"], "timestamp": row["timestamp"]} | ego)
    _write_boxes(plan, samples, keyframes, tables)
    written = Written(root)
    written.table("scene").parent.mkdir(parents=True)
    for name, rows in tables.items():
        written.write(name, rows)
    return written


def _write_scene(
    root: Path,
    plan: Plan,
    scene: str,
    samples: list[str],
    keyframes: list[int],
    tables: Tables,
) -> None:
    (root / "maps").mkdir(parents=True)
    Image.new("L", (4, 4)).save(root / "maps" / "a.png")
    log = {"token": token("log"), "logfile": "n015", "vehicle": "n015", "date_captured": "2018-07-24", "location": "a"}
    tables["log"].append(log)
    tables["map"].append(
        {"token": token("map"), "log_tokens": [log["token"]], "category": "semantic_prior", "filename": "maps/a.png"}
    )
    ends = {"first_sample_token": samples[0], "last_sample_token": samples[-1], "nbr_samples": len(samples)}
    described = {"token": token("scene", scene), "log_token": log["token"], "name": scene, "description": "a {curve}"}
    tables["scene"].append(described | ends)
    for place, frame in enumerate(keyframes):
        row = {"token": samples[place], "timestamp": sweep_end(plan, frame) // 1000, "scene_token": described["token"]}
        tables["sample"].append(row | linked(samples, place))


def linked(tokens: list[str], place: int) -> dict[str, str]:
    return {
        "prev": tokens[place - 1] if place else "",
        "next": tokens[place + 1] if place + 1 < len(tokens) else "",
    }


def _write_sensors(plan: Plan, tables: Tables) -> None:
    mounts = {CHANNELS[one.name]: (one.vehicle_from_camera, one.intrinsics) for one in plan.cameras}
    for channel, (mount, intrinsics) in {**mounts, "LIDAR_TOP": (plan.vehicle_from_lidar, None)}.items():
        modality = "lidar" if intrinsics is None else "camera"
        # nuScenes counts from the center of the first pixel.
        shifted = [] if intrinsics is None else (intrinsics - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).tolist()
        tables["sensor"].append({"token": token("sensor", channel), "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(
            {"token": token("mount", channel), "sensor_token": token("sensor", channel), "camera_intrinsic": shifted}
            | placed(mount)
        )


def _write_file(root: Path, plan: Plan, channel: str, frame: int, folder: str) -> dict[str, Any]:
    """The image or the sweep, and what its row says of it."""
    camera = next((one for one in plan.cameras if CHANNELS[one.name] == channel), None)
    stamp = sweep_end(plan, frame) if camera is None else plan.image_stamp(frame, camera)
    name = f"{folder}/{channel}/n015__{channel}__{stamp // 1000}.{'pcd.bin' if camera is None else 'jpg'}"
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if camera is None:
        points = sensor_points(plan, frame)
        intensities = [*(255 * levels(len(points) - 1)), 7]
        np.column_stack((points, intensities, np.full(len(points), 7))).astype("<f4").tofile(path)
        return {"timestamp": stamp // 1000, "fileformat": "pcd", "height": 0, "width": 0, "filename": name}
    Image.fromarray(plan.image(frame, camera)).save(path, quality=98, subsampling=0)
    size = {"height": camera.height, "width": camera.width}
    return {"timestamp": stamp // 1000, "fileformat": "jpg", "filename": name} | size


def sensor_points(plan: Plan, frame: int) -> np.ndarray:
    """Returns in the lidar's frame, moved by the car's motion to the end of the turn, and one of its own roof."""
    world_from_lidar = plan.world_from_vehicle(sweep_end(plan, frame)) @ plan.vehicle_from_lidar
    return np.concatenate((moved(np.linalg.inv(world_from_lidar), plan.world_points(frame)), [[0.0, 1.2, -0.8]]))


def _write_boxes(plan: Plan, samples: list[str], keyframes: list[int], tables: Tables) -> None:
    length, width, height = plan.box_size
    tokens = [token("box", sample) for sample in samples]
    tables["category"].append({"token": token("car"), "name": "vehicle.car", "description": ""})
    tables["attribute"].append({"token": token("moving"), "name": "vehicle.moving", "description": ""})
    tables["visibility"].append({"token": "4", "level": "v80-100", "description": ""})
    tables["instance"].append(
        {
            "token": token("one"), "category_token": token("car"), "nbr_annotations": len(tokens),
            "first_annotation_token": tokens[0], "last_annotation_token": tokens[-1],
        }
    )  # fmt: skip
    for place, frame in enumerate(keyframes):
        tables["sample_annotation"].append(
            {
                "token": tokens[place], "sample_token": samples[place], "instance_token": token("one"),
                "visibility_token": "4", "attribute_tokens": [token("moving")], "size": [width, length, height],
                "num_lidar_pts": 3 if place else 0, "num_radar_pts": 0,
            }
            | placed(plan.world_from_box(sweep_end(plan, frame)))
            | linked(tokens, place)
        )  # fmt: skip
