"""What the rows of the components say, as the values that both versions share."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sparsestreet.data.problems import fault
from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    REMEDY,
    BoxLabel,
    CameraCalibration,
    ImageMotion,
    LidarCalibration,
    box_label,
    camera_calibration,
    image_motion,
    lidar_calibration,
)
from sparsestreet.data.waymo.v2.tables import CAMERA, LASER, OBJECT, Table

INTRINSIC = [f"intrinsic.{name}" for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
SIZE_AND_DIRECTION = ["width", "height", "rolling_shutter_direction"]
MOUNT = "extrinsic.transform"
INCLINATION = [f"beam_inclination.{name}" for name in ("min", "max")]
INCLINATIONS = "beam_inclination.values"
POSE = "pose.transform"
VELOCITY = [f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
_SHUTTER = "rolling_shutter_params"
TIMES = [
    "pose_timestamp",
    *(f"{_SHUTTER}.{name}" for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")),
]
_BOX = ["center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading"]
BOX = [f"box.{name}" for name in _BOX]
SEEN_BOX = [f"camera_synced_box.{name}" for name in _BOX]
SEEN_BY = "most_visible_camera_name"


def sensor(value: Any, names: dict[int, str], path: Path) -> str:
    """The name of a camera or lidar from its number or its name: both are found in Waymo's files."""
    name = names.get(value) if isinstance(value, int) else value
    if not isinstance(name, str) or name not in names.values():
        raise fault(path, f"a row is of {value!r}, which is not one of {names}", REMEDY)
    return name


def numbers(row: dict[str, Any], columns: Sequence[str], path: Path) -> list[float]:
    """Cells that must be there. Raises LogError, naming file and column, for an empty one."""
    values = [row[column] for column in columns]
    for column, value in zip(columns, values, strict=True):
        if not isinstance(value, int | float):
            raise fault(path, f"a row has {value!r} as {column}, not a number", REMEDY)
    return [float(value) for value in values]


def matrix(row: dict[str, Any], column: str, path: Path) -> list[float]:
    value = row[column]
    if not isinstance(value, list) or not all(isinstance(entry, int | float) for entry in value):
        raise fault(path, f"a row has no numbers as {column}", REMEDY)
    return [float(entry) for entry in value]


def read_cameras(table: Table) -> dict[str, CameraCalibration]:
    found = {}
    for row in table.rows([CAMERA], [*INTRINSIC, MOUNT, *SIZE_AND_DIRECTION]):
        name = sensor(row[CAMERA], CAMERAS, table.path)
        width, height, direction = (int(value) for value in numbers(row, SIZE_AND_DIRECTION, table.path))
        intrinsic, mount = numbers(row, INTRINSIC, table.path), matrix(row, MOUNT, table.path)
        found[name] = camera_calibration(intrinsic, mount, (width, height), direction, table.path, name)
    return found


def read_lidars(table: Table) -> dict[str, LidarCalibration]:
    found = {}
    for row in table.rows([LASER], [MOUNT, *INCLINATION, INCLINATIONS]):
        name = sensor(row[LASER], LIDARS, table.path)
        low, high = numbers(row, INCLINATION, table.path)
        values = row[INCLINATIONS] or []
        found[name] = lidar_calibration(matrix(row, MOUNT, table.path), values, (low, high), table.path, name)
    return found


def read_motion(row: dict[str, Any], path: Path, what: str) -> ImageMotion:
    pose_time, exposure, trigger, done = numbers(row, TIMES, path)
    times = (pose_time, exposure, trigger, done)
    return image_motion(matrix(row, POSE, path), numbers(row, VELOCITY, path), times, path, what)


def read_label(row: dict[str, Any], synced: dict[str, Any] | None, path: Path, synced_path: Path) -> BoxLabel:
    """A row of lidar_box, and that of lidar_camera_synced_box with the same object, if it has one."""
    seen_box = seen_by = None
    if synced is not None:
        seen_by = sensor(synced[SEEN_BY], CAMERAS, synced_path)
        seen_box = numbers(synced, SEEN_BOX, synced_path)
    (kind,) = numbers(row, ["type"], path)
    box = numbers(row, BOX, path)
    return box_label(str(row[OBJECT] or ""), int(kind), box, path, "a frame", seen_box=seen_box, seen_by=seen_by)
