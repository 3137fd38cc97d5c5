"""Writes a log as a segment of version 1: a record a frame, of fields as ``wire`` and ``messages`` read them."""

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.waymo.log_boxes import LogBoxes
from sparsestreet.data.waymo.log_segment import LogSegment
from sparsestreet.data.waymo.pixels import DIVISOR
from sparsestreet.data.waymo.segment import CAMERAS, BoxLabel
from sparsestreet.data.waymo.v1 import messages as fields
from sparsestreet.data.waymo.v1.records import masked_crc32c
from sparsestreet.data.waymo.writer import WaymoWriter
from sparsestreet.data.writer import LogFile
from sparsestreet.types import View

_TOP = 1
_NUMBERS = {name: number for number, name in CAMERAS.items()}
_PACKED = 6
"""Of zlib: most pixels of a range image are equal."""


@dataclass(frozen=True, kw_only=True)
class WaymoV1Writer(WaymoWriter):
    """``segment-NAME_with_camera_labels.tfrecord``, which takes no library."""

    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        segment = self.segment(log)
        records = partial(_records, segment, LogBoxes(segment), self.jpeg_quality)
        yield LogFile(f"segment-{segment.name}_with_camera_labels.tfrecord", records)


def _records(segment: LogSegment, boxes: LogBoxes, quality: int | None) -> Iterable[bytes]:
    for frame in range(segment.log.num_frames):
        message = b"".join(_frame(segment, boxes, quality, frame))
        length = struct.pack("<Q", len(message))
        yield length + struct.pack("<I", masked_crc32c(length))
        yield message
        yield struct.pack("<I", masked_crc32c(message))


def _frame(segment: LogSegment, boxes: LogBoxes, quality: int | None, frame: int) -> Iterator[bytes]:
    yield _data(fields.CONTEXT, b"".join(_context(segment)))
    yield _integer(fields.STAMP, segment.stamps[frame])
    yield _data(fields.POSE, _pose(segment.world_from_vehicle(frame)))
    for name, view in segment.views(frame).items():
        yield _data(fields.IMAGES, b"".join(_image(segment, quality, name, view)))
    if (placed := segment.places(frame)) is not None:
        poses = _data(4, _matrix(segment.pixel_poses(frame, placed.ranges)))
        first, second = (_data(2, _matrix(placed.image(number))) for number in range(2))
        yield _data(fields.LASERS, _integer(1, _TOP) + _data(2, first + poses) + _data(3, second))
    for label in boxes.labels(frame):
        yield _data(fields.LABELS, b"".join(_label(label)))


def _context(segment: LogSegment) -> Iterator[bytes]:
    yield _data(1, segment.name.encode())
    for name, camera in segment.cameras.items():
        size = _integer(4, camera.size[0]) + _integer(5, camera.size[1]) + _integer(6, camera.direction)
        mount = _data(3, _pose(camera.vehicle_from_camera))
        yield _data(2, _integer(1, _NUMBERS[name]) + _doubles(2, camera.intrinsic) + mount + size)
    if (lidar := segment.lidar) is not None:
        limits = _double(3, lidar.limits[0]) + _double(4, lidar.limits[1])
        mount = _data(5, _pose(lidar.vehicle_from_lidar))
        yield _data(3, _integer(1, _TOP) + _doubles(2, lidar.inclinations) + limits + mount)


def _image(segment: LogSegment, quality: int | None, name: str, view: View) -> Iterator[bytes]:
    motion = segment.motion(name, view)
    yield _integer(fields.NAME, _NUMBERS[name])
    yield _data(fields.JPEG, segment.picture(view, quality))
    yield _data(3, _pose(motion.world_from_vehicle))
    linear = (_single(1 + axis, value) for axis, value in enumerate(motion.linear.tolist()))
    angular = (_double(4 + axis, value) for axis, value in enumerate(motion.angular.tolist()))
    yield _data(4, b"".join((*linear, *angular)))
    yield _double(5, motion.pose_time) + _double(6, motion.exposure)
    yield _double(7, motion.trigger) + _double(8, motion.readout_done)
    if (label := segment.labels(view)) is not None:
        yield _data(fields.PANOPTIC, _integer(1, DIVISOR) + _data(2, label))


def _label(label: BoxLabel) -> Iterator[bytes]:
    yield _data(1, _box(label.box))
    yield _integer(3, label.kind)
    yield _data(4, label.name.encode())
    if label.seen_by is not None and label.seen_box is not None:
        yield _data(11, label.seen_by.encode())
        yield _data(12, _box(label.seen_box))


def _box(values: tuple[float, ...]) -> bytes:
    """Center, length (5) before width (4), height, heading, as ``messages.read_label`` takes them."""
    return b"".join(_double(number, value) for number, value in zip((1, 2, 3, 5, 4, 6, 7), values, strict=True))


def _matrix(values: Float32[np.ndarray, "h w c"]) -> bytes:
    """Numbers and shape, packed by zlib."""
    packer = zlib.compressobj(_PACKED)
    shape = _data(2, _data(1, b"".join(map(_varint, values.shape))))
    head = _varint(1 << 3 | 2) + _varint(values.nbytes)
    packed = packer.compress(head) + packer.compress(np.ascontiguousarray(values, "<f4").data.cast("B"))
    return packed + packer.compress(shape) + packer.flush()


def _pose(pose: Tensor) -> bytes:
    return _doubles(1, pose.flatten().tolist())


def _varint(value: int) -> bytes:
    """In groups of seven bits, the lowest first; negative ones as 64 bits."""
    value &= 2**64 - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _integer(number: int, value: int) -> bytes:
    return _varint(number << 3) + _varint(value)


def _double(number: int, value: float) -> bytes:
    return _varint(number << 3 | 1) + struct.pack("<d", value)


def _single(number: int, value: float) -> bytes:
    return _varint(number << 3 | 5) + struct.pack("<f", value)


def _data(number: int, value: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _doubles(number: int, values: Iterable[float]) -> bytes:
    return _data(number, np.array(list(values), "<f8").tobytes())
