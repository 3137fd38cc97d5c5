"""Writes version 2: a file a component. Columns are those that Waymo's classes declare."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.data.waymo.drive import DIVISOR, NAMES, OPENCV, Drive
from tests.data.waymo.records import NAME

SEGMENT, FRAME, CAMERA = "key.segment_context_name", "key.frame_timestamp_micros", "key.camera_name"
LASER, OBJECT = "key.laser_name", "key.laser_object_id"
_BOX = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
_INTRINSIC = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_VELOCITY = [f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
_SHUTTER = "rolling_shutter_params."
_TIMES = [
    "pose_timestamp",
    *(_SHUTTER + name for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")),
]
Row = dict[str, Any]


def rows_of(drive: Drive, name: str = NAME) -> dict[str, tuple[str, list[Row]]]:
    """Component's folder -> its class and rows, without the class before their columns."""
    frames = range(drive.num_frames)
    keys = [{SEGMENT: name, FRAME: drive.begin(frame) // 1000} for frame in frames]
    poses = [{"world_from_vehicle.transform": drive.frame_pose(frame).ravel()} for frame in frames]
    boxes = [_box("box.", drive.box(frame, drive.box_stamp(frame))) | {"type": 1} for frame in frames]
    found = {
        "vehicle_pose": ("VehiclePoseComponent", _joined(keys, poses)),
        "camera_calibration": ("CameraCalibrationComponent", _cameras(drive, name)),
        "lidar_calibration": ("LiDARCalibrationComponent", _lidars(drive, name)),
        "lidar_box": ("LiDARBoxComponent", _joined(keys, boxes, {OBJECT: drive.box_name})),
        "camera_image": (
            "CameraImageComponent",
            [keys[frame] | row for frame in frames for row in _images(drive, frame)],
        ),
        "lidar": ("LiDARComponent", [keys[frame] | row for frame in frames for row in _returns(drive, frame)]),
        "lidar_pose": ("LiDARPoseComponent", [keys[frame] | _poses(drive, frame) for frame in frames]),
    }
    labels = [
        keys[frame]
        | {CAMERA: NAMES[one.name], "panoptic_label_divisor": DIVISOR, "panoptic_label": drive.panoptic(one)}
        for frame in frames
        for one in drive.cameras
        if (frame, one.name) in drive.labelled
    ]
    if labels:
        found["camera_segmentation"] = "CameraSegmentationLabelComponent", labels
    if drive.synced:
        seen = [_box("camera_synced_box.", drive.box(frame, drive.seen_stamp(frame))) for frame in frames]
        extra = {OBJECT: drive.box_name, "most_visible_camera_name": 1}
        found["lidar_camera_synced_box"] = "LiDARCameraSyncedBoxComponent", _joined(keys, seen, extra)
    return found


def write_drive(
    root: Path,
    drive: Drive,
    name: str = NAME,
    *,
    change: Callable[[str, list[Row]], list[Row]] = lambda component, rows: rows,
    single: bool = False,
    group: int = 5,
) -> Path:
    """``single``: pose matrices as float32, as a genuine file has them; ``group``: rows of a group."""
    for component, (prefix, rows) in rows_of(drive, name).items():
        write(root / component / f"{name}.parquet", prefix, change(component, rows), single=single, group=group)
    return root


def write(path: Path, prefix: str, rows: list[Row], *, single: bool = False, group: int = 5) -> None:
    import pyarrow
    import pyarrow.parquet

    columns = {}
    for key in rows[0]:
        cells = [row[key].tolist() if isinstance(row[key], np.ndarray) else row[key] for row in rows]
        kind = None
        if key.endswith("transform"):
            kind = pyarrow.list_(pyarrow.float32() if single else pyarrow.float64(), 16)
        elif key.endswith("return1.values") or key.endswith("return2.values"):
            kind = pyarrow.list_(pyarrow.float32())
        elif key.endswith(".shape"):
            kind = pyarrow.list_(pyarrow.int32(), 3)
        elif isinstance(cells[0], list):
            kind = pyarrow.list_(pyarrow.float64())
        columns[key if key.startswith("key.") else f"[{prefix}].{key}"] = pyarrow.array(cells, kind)
    path.parent.mkdir(parents=True, exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.table(columns), path, row_group_size=group)


def _joined(keys: list[Row], rows: list[Row], extra: Row | None = None) -> list[Row]:
    return [key | (extra or {}) | row for key, row in zip(keys, rows, strict=True)]


def _box(prefix: str, values: list[float]) -> Row:
    return {prefix + name: value for name, value in zip(_BOX, values, strict=True)}


def _cameras(drive: Drive, name: str) -> list[Row]:
    return [
        {SEGMENT: name, CAMERA: NAMES[one.name]}
        | {f"intrinsic.{key}": value for key, value in zip(_INTRINSIC, drive.intrinsic(one), strict=True)}
        | {"extrinsic.transform": (one.vehicle_from_camera @ np.linalg.inv(OPENCV)).ravel()}
        | {"width": one.width, "height": one.height, "rolling_shutter_direction": drive.directions[one.name]}
        for one in drive.cameras
    ]


def _lidars(drive: Drive, name: str) -> list[Row]:
    ascending = drive.inclinations[::-1]
    mounts = (drive.vehicle_from_lidar, drive.ahead_from_lidar)
    limits = ((ascending[0], ascending[-1]), (-np.pi / 2, np.pi / 6))
    return [
        {SEGMENT: name, LASER: place + 1, "extrinsic.transform": mounts[place].ravel()}
        | {"beam_inclination.min": limits[place][0], "beam_inclination.max": limits[place][1]}
        | {"beam_inclination.values": [ascending.tolist(), None][place]}
        for place in range(2)
    ]


def _images(drive: Drive, frame: int) -> list[Row]:
    rows = []
    for one in drive.cameras:
        stamp = drive.image_pose_stamp(frame, one)
        row = {CAMERA: NAMES[one.name], "image": drive.png(frame, one)}
        row["pose.transform"] = drive.world_from_vehicle(stamp).ravel()
        row |= dict(zip(_VELOCITY, drive.velocity(stamp), strict=True))
        rows.append(row | dict(zip(_TIMES, drive.image_times(frame, one), strict=True)))
    return rows


def _returns(drive: Drive, frame: int) -> list[Row]:
    first, second, _ = drive.top(frame)
    ahead = drive.ahead(frame)
    return [_lidar(1, first, second), _lidar(2, ahead, np.full_like(ahead, -1))]


def _lidar(number: int, first: np.ndarray, second: np.ndarray) -> Row:
    row: Row = {LASER: number}
    for place, image in ((1, first), (2, second)):
        row |= {f"range_image_return{place}.values": image.ravel(), f"range_image_return{place}.shape": [*image.shape]}
    return row


def _poses(drive: Drive, frame: int) -> Row:
    poses = drive.top(frame)[2]
    values = {"range_image_return1.values": poses.ravel(), "range_image_return1.shape": [*poses.shape]}
    return {LASER: 1} | values
