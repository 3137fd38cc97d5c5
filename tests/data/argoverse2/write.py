"""The planned drive in the layout of Argoverse 2's sensor data set."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from sparsestreet.geometry import quaternions as quat
from tests.data.plan import Plan, moved

MIDDLE = 50_000_000
"""Nanoseconds from the stamp of a sweep to its middle, which is the stamp of the plan's frame."""
CAMERAS = {"ring_front_center": ("front", 38_000_000), "ring_front_left": ("left", 26_000_000)}
"""The plan's name, and nanoseconds from the stamp of the sweep to the image that belongs to it; one is 50 ms later."""
LOG = "7f00aaaa-0000-3000-a000-000000000001"
UUID = "11111111-2222-3333-4444-555555555555"


def write_log(root: Path, plan: Plan | None = None, *, points: type = np.float16) -> Path:
    """The folder of the log, below ``root``; ``points`` is the type of x, y, z (float16 in the data set)."""
    plan = Plan() if plan is None else plan
    log = root / "val" / LOG
    for folder in ("calibration", "sensors/lidar"):
        (log / folder).mkdir(parents=True)
    _write_poses(log, plan)
    _write_calibration(log, plan)
    for frame in range(plan.num_frames):
        _write_sweep(log, plan, frame, points)
        for name, (planned, delay) in CAMERAS.items():
            camera = next(one for one in plan.cameras if one.name == planned)
            pixels = plan.image(frame, camera)
            for late, image in ((0, pixels), (50_000_000, 255 - pixels)):
                path = log / "sensors/cameras" / name / f"{sweep_stamp(plan, frame) + delay + late}.jpg"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(image).save(path, quality=95)
    _write_boxes(log, plan)
    return log


def sweep_stamp(plan: Plan, frame: int) -> int:
    return int(plan.stamps[frame]) - MIDDLE


def write_table(path: Path, columns: Mapping[str, Any], **options: Any) -> None:
    import pyarrow as pa
    from pyarrow import feather

    feather.write_feather(pa.table(dict(columns)), str(path), **options)


def read_table(path: Path) -> dict[str, Any]:
    """Columns as arrays that may be changed and written again."""
    from pyarrow import feather

    table = feather.read_table(str(path), memory_map=False)
    return {name: table[name].to_numpy().copy() for name in table.column_names}


def transforms(poses: np.ndarray) -> dict[str, np.ndarray]:
    quaternions = quat.from_matrix(torch.from_numpy(poses[:, :3, :3])).numpy()
    named = {name: quaternions[:, place] for place, name in enumerate(("qw", "qx", "qy", "qz"))}
    return named | {name: poses[:, place, 3].copy() for place, name in enumerate(("tx_m", "ty_m", "tz_m"))}


def _write_poses(log: Path, plan: Plan) -> None:
    """Every 5 ms and at the sweeps, there another one 2 ns later, as in genuine logs."""
    sweeps = plan.stamps - MIDDLE
    regular = np.arange(sweeps[0] - 61_000_000, sweeps[-1] + 200_000_000, 5_000_000)
    stamps = np.sort(np.concatenate((regular, sweeps, sweeps + 2)))
    write_table(
        log / "city_SE3_egovehicle.feather", {"timestamp_ns": stamps} | transforms(plan.world_from_vehicle(stamps))
    )


def _write_calibration(log: Path, plan: Plan) -> None:
    cameras = {name: next(one for one in plan.cameras if one.name == CAMERAS[name][0]) for name in CAMERAS}
    k = np.stack([camera.intrinsics for camera in cameras.values()])
    numbers = {"fx_px": k[:, 0, 0], "fy_px": k[:, 1, 1], "cx_px": k[:, 0, 2] - 0.5, "cy_px": k[:, 1, 2] - 0.5}
    # The lens of the camera: the images are shipped without it.
    lens = {name: np.full(len(cameras), value) for name, value in (("k1", -0.24), ("k2", -0.21), ("k3", 0.33))}
    sizes = {
        "height_px": np.array([camera.height for camera in cameras.values()], np.uint16),
        "width_px": np.array([camera.width for camera in cameras.values()], np.uint16),
    }
    write_table(log / "calibration/intrinsics.feather", {"sensor_name": list(cameras)} | numbers | lens | sizes)
    mounts = [camera.vehicle_from_camera for camera in cameras.values()]
    names = [*cameras, "up_lidar", "down_lidar"]
    lower = plan.vehicle_from_lidar - np.outer([0, 0, 0.2, 0], [0, 0, 0, 1])
    poses = transforms(np.stack([*mounts, plan.vehicle_from_lidar, lower]))
    write_table(log / "calibration/egovehicle_SE3_sensor.feather", {"sensor_name": names} | poses)


def ego_points(plan: Plan, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns in the vehicle's frame at the stamp of the sweep, and nanoseconds from there to their own instants."""
    _, stamps = plan.sweep(frame)
    back = np.linalg.inv(plan.world_from_vehicle(sweep_stamp(plan, frame)))
    order = np.argsort(stamps, kind="stable")
    return moved(back, plan.world_points(frame))[order], (stamps - sweep_stamp(plan, frame))[order]


def _write_sweep(log: Path, plan: Plan, frame: int, kind: type) -> None:
    points, offsets = ego_points(plan, frame)
    columns = {axis: points[:, place].astype(kind) for place, axis in enumerate("xyz")}
    columns["intensity"] = np.full(len(points), 9, np.uint8)
    columns["laser_number"] = (np.arange(len(points)) % 64).astype(np.uint8)
    columns["offset_ns"] = offsets.astype(np.int32)
    write_table(log / "sensors/lidar" / f"{sweep_stamp(plan, frame)}.feather", columns)


def _write_boxes(log: Path, plan: Plan) -> None:
    """The planned box, and a bollard that stands only at the first sweep."""
    stamps = plan.stamps - MIDDLE
    poses = np.linalg.inv(plan.world_from_vehicle(stamps)) @ plan.world_from_box(stamps)
    bollard = np.eye(4)[None]
    bollard[0, :3, 3] = (5, 3, 0.5)
    sizes = np.concatenate((np.tile(plan.box_size, (len(stamps), 1)), [[0.3, 0.3, 1.0]]))
    columns: dict[str, Any] = {
        "timestamp_ns": np.append(stamps, stamps[0]),
        "track_uuid": [UUID] * len(stamps) + ["bollard"],
        "category": ["REGULAR_VEHICLE"] * len(stamps) + ["BOLLARD"],
    }
    columns |= {name: sizes[:, place].copy() for place, name in enumerate(("length_m", "width_m", "height_m"))}
    columns |= transforms(np.concatenate((poses, bollard)))
    columns["num_interior_pts"] = np.zeros(len(sizes), np.int64)
    write_table(log / "annotations.feather", columns)
