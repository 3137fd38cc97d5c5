"""Writes version 1: a record a frame. Numbers of fields are those of Waymo's dataset.proto and label.proto."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.data.waymo.drive import DIVISOR, NAMES, OPENCV, Drive

NAME = "1024360143612057520_3580_000_3600_000"


def varint(value: int) -> bytes:
    value &= 2**64 - 1
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def integer(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)


def double(number: int, value: float) -> bytes:
    return varint(number << 3 | 1) + struct.pack("<d", value)


def single(number: int, value: float) -> bytes:
    return varint(number << 3 | 5) + struct.pack("<f", value)


def data(number: int, value: bytes | str) -> bytes:
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def doubles(number: int, values: Sequence[float] | np.ndarray, *, packed: bool = True) -> bytes:
    if packed:
        return data(number, np.asarray(values, "<f8").tobytes())
    return b"".join(double(number, value) for value in values)


def matrix(pose: np.ndarray, *, packed: bool = True) -> bytes:
    return doubles(1, pose.ravel(), packed=packed)


def floats(values: np.ndarray) -> bytes:
    """A MatrixFloat packed by zlib."""
    shape = data(1, b"".join(map(varint, values.shape)))
    return zlib.compress(data(1, values.astype("<f4").tobytes()) + data(2, shape))


def context(drive: Drive, name: str = NAME, *, packed: bool = True) -> bytes:
    parts = [data(1, name)]
    for camera in drive.cameras:
        parts.append(
            data(
                2,
                integer(1, NAMES[camera.name])
                + doubles(2, drive.intrinsic(camera), packed=packed)
                + data(3, matrix(camera.vehicle_from_camera @ np.linalg.inv(OPENCV), packed=packed))
                + integer(4, camera.width)
                + integer(5, camera.height)
                + integer(6, drive.directions[camera.name]),
            )
        )
    ascending = drive.inclinations[::-1]
    limits = double(3, ascending[0]) + double(4, ascending[-1])
    mount = data(5, matrix(drive.vehicle_from_lidar))
    parts.append(data(3, integer(1, 1) + doubles(2, ascending, packed=packed) + limits + mount))
    limits = double(3, -np.pi / 2) + double(4, np.pi / 6)
    parts.append(data(3, integer(1, 2) + limits + data(5, matrix(drive.ahead_from_lidar))))
    return b"".join(parts)


def image(drive: Drive, frame: int, number: int) -> bytes:
    camera = drive.cameras[number]
    stamp = drive.image_pose_stamp(frame, camera)
    velocity = drive.velocity(stamp)
    moving = b"".join(single(1 + axis, value) for axis, value in enumerate(velocity[:3]))
    moving += b"".join(double(4 + axis, value) for axis, value in enumerate(velocity[3:]))
    pose_time, exposure, trigger, done = drive.image_times(frame, camera)
    parts = [
        integer(1, NAMES[camera.name]),
        data(2, drive.png(frame, camera)),
        data(3, matrix(drive.world_from_vehicle(stamp))),
        data(4, moving),
        double(5, pose_time) + double(6, exposure) + double(7, trigger) + double(8, done),
    ]
    if (frame, camera.name) in drive.labelled:
        parts.append(data(10, integer(1, DIVISOR) + data(2, drive.panoptic(camera)) + data(4, "sequence")))
    return b"".join(parts)


def label(drive: Drive, frame: int) -> bytes:
    parts = [data(1, _box(drive.box(frame, drive.box_stamp(frame)))), integer(3, 1), data(4, drive.box_name)]
    parts.append(data(2, double(1, 8.0) + double(2, 0.0)) + integer(7, 25))
    if drive.synced:
        parts.append(data(11, "FRONT") + data(12, _box(drive.box(frame, drive.seen_stamp(frame)))))
    return b"".join(parts)


def lasers(drive: Drive, frame: int) -> list[bytes]:
    first, second, poses = drive.top(frame)
    top = integer(1, 1) + data(2, data(2, floats(first)) + data(4, floats(poses))) + data(3, data(2, floats(second)))
    return [top, integer(1, 2) + data(2, data(2, floats(drive.ahead(frame))))]


def message(drive: Drive, frame: int, name: str = NAME) -> bytes:
    """A Frame; cameras in an order of their own, as Waymo has them."""
    parts = [data(1, context(drive, name)), integer(2, drive.begin(frame) // 1000)]
    parts.append(data(3, matrix(drive.frame_pose(frame))))
    parts += [data(4, image(drive, frame, number)) for number in reversed(range(len(drive.cameras)))]
    parts += [data(5, laser) for laser in lasers(drive, frame)]
    sign = data(1, _box([9.0, 4, 2, 0.1, 0.5, 0.5, 0])) + integer(3, 3) + data(4, "sign")
    parts += [data(6, label(drive, frame)), data(6, sign), data(8, b"\x08\x01")]
    return b"".join(parts)


def write(path: Path, messages: Sequence[bytes]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(map(record, messages)))
    return path


def write_drive(root: Path, drive: Drive, name: str = NAME) -> Path:
    path = root / f"segment-{name}_with_camera_labels.tfrecord"
    return write(path, [message(drive, frame, name) for frame in range(drive.num_frames)])


def record(payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    return length + struct.pack("<I", masked(length)) + payload + struct.pack("<I", masked(payload))


def masked(payload: bytes) -> int:
    """CRC-32C bit by bit, straight from its definition."""
    crc = 0xFFFFFFFF
    for byte in payload:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 255]
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _entry(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    return value


_TABLE = [_entry(value) for value in range(256)]


def _box(values: Sequence[float]) -> bytes:
    """Center, length, width, height, heading; the width is field 4 and the length field 5."""
    return b"".join(double(number, values[place]) for place, number in enumerate((1, 2, 3, 5, 4, 6, 7)))
