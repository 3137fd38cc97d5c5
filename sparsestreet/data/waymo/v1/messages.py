"""What the messages of a frame say; the numbers of their fields are those of Waymo's dataset.proto and label.proto."""

import math
import zlib

import numpy as np
from jaxtyping import Float

from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    BoxLabel,
    CameraCalibration,
    ImageMotion,
    LidarCalibration,
    box_label,
    camera_calibration,
    image_motion,
    lidar_calibration,
)
from sparsestreet.data.waymo.v1.wire import Message

CONTEXT, STAMP, POSE, IMAGES, LASERS, LABELS = 1, 2, 3, 4, 5, 6
NAME, JPEG, PANOPTIC = 1, 2, 10
_MAX_UNPACKED = 64 * 2**20
"""Bytes: the poses of TOP's pixels take 4 million."""


def named(message: Message, names: dict[int, str]) -> str:
    """The camera or lidar that a message is of."""
    number = message.integer(NAME, 0)
    if number not in names:
        raise message.error(f"it is of number {number}, not one of {names}")
    return names[number]


def read_cameras(context: Message) -> dict[str, CameraCalibration]:
    found = {}
    for message in context.messages(2, "camera_calibrations"):
        name = named(message, CAMERAS)
        found[name] = camera_calibration(
            message.doubles(2).tolist(),
            message.message(3, "extrinsic").doubles(1),
            (message.integer(4, 0), message.integer(5, 0)),
            message.integer(6, 0),
            message.path,
            name,
        )
    return found


def read_lidars(context: Message) -> dict[str, LidarCalibration]:
    found = {}
    for message in context.messages(3, "laser_calibrations"):
        name = named(message, LIDARS)
        limits = message.number(3, 0.0), message.number(4, 0.0)
        extrinsic = message.message(5, "extrinsic").doubles(1)
        found[name] = lidar_calibration(extrinsic, message.doubles(2), limits, message.path, name)
    return found


def read_motion(message: Message) -> ImageMotion:
    velocity = message.message(4, "velocity")
    times = (message.number(5), message.number(6), message.number(7), message.number(8))
    return image_motion(
        message.message(3, "pose").doubles(1),
        [velocity.number(field, 0.0) for field in range(1, 7)],
        times,
        message.path,
        message.what,
    )


def read_label(message: Message) -> BoxLabel:
    seen_by = message.text(11)
    synced = message.message(12, "camera_synced_box") if 12 in message else None
    if synced is not None and seen_by not in CAMERAS.values():
        raise message.error(f"the camera {seen_by!r} of its camera_synced_box is not one of {list(CAMERAS.values())}")
    return box_label(
        message.text(4),
        message.integer(3, 0),
        _box(message.message(1, "box")),
        message.path,
        message.what,
        seen_box=None if synced is None else _box(synced),
        seen_by=None if synced is None else seen_by,
    )


def _box(message: Message) -> list[float]:
    """Center, then length (5) before width (4), height, heading."""
    return [message.number(field, 0.0) for field in (1, 2, 3, 5, 4, 6, 7)]


def range_image(message: Message, field: int, channels: int) -> Float[np.ndarray, "h w c"] | None:
    """A matrix of floats, packed by zlib into a field; None where the field is absent or empty."""
    packed = message.data(field)
    if not len(packed):
        return None
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(packed, _MAX_UNPACKED)
    except zlib.error as error:
        raise message.error(f"field {field} cannot be unpacked ({error})") from error
    if not unpacker.eof:
        raise message.error(f"field {field} ends within its packed bytes, or unpacks to more than 64 MiB")
    matrix = Message(memoryview(unpacked), message.path, f"{message.what}, field {field}")
    shape, values = matrix.message(2, "shape").integers(1), matrix.floats(1)
    if len(shape) != 3 or shape[2] != channels or 0 in shape or math.prod(shape) != len(values):
        raise matrix.error(f"it has {len(values)} numbers for the shape {shape[:6]}, which needs {channels} channels")
    return values.reshape(shape)
