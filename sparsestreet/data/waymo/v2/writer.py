"""Writes a log as a segment of version 2: a table a component. Memory holds the rows of one frame."""

import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.waymo.log_boxes import LogBoxes
from sparsestreet.data.waymo.log_segment import LogSegment
from sparsestreet.data.waymo.pixels import DIVISOR
from sparsestreet.data.waymo.segment import CAMERAS
from sparsestreet.data.waymo.v2 import components
from sparsestreet.data.waymo.v2 import segment as names
from sparsestreet.data.waymo.v2.tables import CAMERA, FRAME, LASER, OBJECT, SEGMENT
from sparsestreet.data.waymo.writer import WaymoWriter
from sparsestreet.data.writer import LogFile

_TOP = 1
_NUMBERS = {name: number for number, name in CAMERAS.items()}
Row = dict[str, Any]
Groups = Iterator[list[Row]]


@dataclass(frozen=True, kw_only=True)
class WaymoV2Writer(WaymoWriter):
    """``COMPONENT/SEGMENT.parquet``, with the columns that are known. Needs pyarrow."""

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        arrow, segment = _pyarrow(), self.segment(log)
        boxes = LogBoxes(segment)
        tables: Mapping[str, tuple[str, Callable[[], Groups]]] = {
            "vehicle_pose": ("VehiclePoseComponent", partial(_poses, segment)),
            "camera_calibration": ("CameraCalibrationComponent", partial(_cameras, segment)),
            "camera_image": ("CameraImageComponent", partial(_images, segment, self.jpeg_quality)),
            "camera_segmentation": ("CameraSegmentationLabelComponent", partial(_labels, segment)),
            "lidar_calibration": ("LiDARCalibrationComponent", partial(_lidars, segment)),
            "lidar": ("LiDARComponent", partial(_returns, segment)),
            "lidar_pose": ("LiDARPoseComponent", partial(_pixel_poses, segment)),
            "lidar_box": ("LiDARBoxComponent", partial(_boxes, segment, boxes)),
            "lidar_camera_synced_box": ("LiDARCameraSyncedBoxComponent", partial(_seen_boxes, segment, boxes)),
        }
        for component, (prefix, groups) in tables.items():
            # Tables without rows are not written; those of masks would be found by decoding the images twice.
            if next((group for group in groups() if group), None) is not None:
                yield LogFile(f"{component}/{segment.name}.parquet", partial(_parquet, arrow, prefix, groups))


def _poses(segment: LogSegment) -> Groups:
    yield [
        _key(segment, frame) | {names.VEHICLE_POSE: _flat(segment.world_from_vehicle(frame))} for frame in _all(segment)
    ]


def _cameras(segment: LogSegment) -> Groups:
    rows = []
    for name, camera in segment.cameras.items():
        row: Row = {SEGMENT: segment.name, CAMERA: _NUMBERS[name], components.MOUNT: _flat(camera.vehicle_from_camera)}
        row |= dict(zip(components.INTRINSIC, camera.intrinsic, strict=True))
        rows.append(row | dict(zip(components.SIZE_AND_DIRECTION, (*camera.size, camera.direction), strict=True)))
    yield rows


def _images(segment: LogSegment, quality: int | None) -> Groups:
    for frame in _all(segment):
        rows = []
        for name, view in segment.views(frame).items():
            motion = segment.motion(name, view)
            row = _key(segment, frame) | {CAMERA: _NUMBERS[name], "image": segment.picture(view, quality)}
            row |= {components.POSE: _flat(motion.world_from_vehicle)}
            velocity = (*motion.linear.tolist(), *motion.angular.tolist())
            row |= dict(zip(components.VELOCITY, velocity, strict=True))
            times = (motion.pose_time, motion.exposure, motion.trigger, motion.readout_done)
            rows.append(row | dict(zip(components.TIMES, times, strict=True)))
        yield rows


def _labels(segment: LogSegment) -> Groups:
    for frame in _all(segment):
        found = {name: segment.labels(view) for name, view in segment.views(frame).items()}
        yield [
            _key(segment, frame) | {CAMERA: _NUMBERS[name], names.LABEL: label, names.DIVISOR: DIVISOR}
            for name, label in found.items()
            if label is not None
        ]


def _lidars(segment: LogSegment) -> Groups:
    if (lidar := segment.lidar) is not None:
        row: Row = {SEGMENT: segment.name, LASER: _TOP, components.MOUNT: _flat(lidar.vehicle_from_lidar)}
        row |= dict(zip(components.INCLINATION, lidar.limits, strict=True))
        yield [row | {components.INCLINATIONS: lidar.inclinations}]


def _returns(segment: LogSegment) -> Groups:
    for frame in _all(segment):
        if (placed := segment.places(frame)) is not None:
            row = _key(segment, frame) | {LASER: _TOP}
            for number in range(2):
                image = placed.image(number)
                row |= dict(zip(names.RETURNS[2 * number :][:2], (image.ravel(), image.shape), strict=True))
            yield [row]


def _pixel_poses(segment: LogSegment) -> Groups:
    for frame in _all(segment):
        if (placed := segment.places(frame)) is not None:
            image = segment.pixel_poses(frame, placed.ranges)
            cells = dict(zip(names.RETURNS[:2], (image.ravel(), image.shape), strict=True))
            yield [_key(segment, frame) | {LASER: _TOP} | cells]


def _boxes(segment: LogSegment, boxes: LogBoxes) -> Groups:
    yield [
        _key(segment, frame) | {OBJECT: one.name, "type": one.kind} | dict(zip(components.BOX, one.box, strict=True))
        for frame in _all(segment)
        for one in boxes.labels(frame)
    ]


def _seen_boxes(segment: LogSegment, boxes: LogBoxes) -> Groups:
    yield [
        _key(segment, frame)
        | {OBJECT: one.name, components.SEEN_BY: _NUMBERS[one.seen_by]}
        | dict(zip(components.SEEN_BOX, one.seen_box, strict=True))
        for frame in _all(segment)
        for one in boxes.labels(frame)
        if one.seen_by is not None and one.seen_box is not None
    ]


def _all(segment: LogSegment) -> range:
    return range(segment.log.num_frames)


def _key(segment: LogSegment, frame: int) -> Row:
    return {SEGMENT: segment.name, FRAME: segment.stamps[frame]}


def _flat(pose: Any) -> list[float]:
    return pose.flatten().tolist()


class _Parts(io.RawIOBase):
    """A file that only grows; what was written since it was last asked is handed on."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._end = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        self._end += len(self._parts[-1])
        return len(self._parts[-1])

    def tell(self) -> int:
        return self._end

    def taken(self) -> list[bytes]:
        parts, self._parts = self._parts, []
        return parts


def _parquet(arrow: ModuleType, prefix: str, groups: Callable[[], Groups]) -> Iterable[bytes]:
    """The bytes of a table, a group of rows at a time."""
    file, writer = _Parts(), None
    for rows in groups():
        if not rows:
            continue
        columns = {name: arrow.array([row[name] for row in rows], _kind(arrow, name)) for name in rows[0]}
        named = {name if name.startswith("key.") else f"[{prefix}].{name}": cells for name, cells in columns.items()}
        table = arrow.table(named)
        if writer is None:
            writer = arrow.parquet.ParquetWriter(file, table.schema)
        writer.write_table(table)
        yield from file.taken()
    assert writer is not None  # a file is asked for where there are rows
    writer.close()
    yield from file.taken()


def _kind(arrow: ModuleType, name: str) -> Any:
    """The type that Waymo's own tables have."""
    ends = {
        "transform": arrow.list_(arrow.float64(), 16),
        components.INCLINATIONS: arrow.list_(arrow.float64()),
        "values": arrow.list_(arrow.float32()),
        "shape": arrow.list_(arrow.int32(), 3),
        **dict.fromkeys(components.VELOCITY[:3], arrow.float32()),
        **dict.fromkeys((SEGMENT, OBJECT), arrow.string()),
        **dict.fromkeys(("image", names.LABEL), arrow.binary()),
        **dict.fromkeys((CAMERA, LASER, components.SEEN_BY, "type", "rolling_shutter_direction"), arrow.int8()),
        **dict.fromkeys(("width", "height", names.DIVISOR), arrow.int32()),
        FRAME: arrow.int64(),
    }
    return next((kind for end, kind in ends.items() if name == end or name.endswith(f".{end}")), arrow.float64())


def _pyarrow() -> ModuleType:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "tables in parquet files need pyarrow, which is not installed: pip install 'sparsestreet[parquet]'"
        ) from missing
    return pyarrow
