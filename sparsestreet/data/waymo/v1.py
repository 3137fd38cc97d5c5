"""Segments of Waymo's version 1: a file of records (TFRecord), a record the message of one frame (protobuf).

A record is its length (8 bytes), a checksum of that (4 bytes), its bytes, and a checksum of these (4 bytes). A message
has numbered fields and no names; the numbers are those of Waymo's dataset.proto and label.proto.
"""

import math
import mmap
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import google_crc32c
import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, Problem, fault
from sparsestreet.data.reader import LogFiles
from sparsestreet.data.waymo.segment import (
    CAMERAS,
    LIDARS,
    REMEDY,
    BoxLabel,
    CameraCalibration,
    ImageMotion,
    LidarCalibration,
    Returns,
    Segment,
    box_label,
    camera_calibration,
    image_motion,
    lidar_calibration,
    returns_of,
    transform,
)

_HEADER, _FOOTER = 12, 4
_MAX_RECORDS = 2_000
"""Ten times the frames of a segment."""
_GZIP = b"\x1f\x8b"


class Records:
    """The records of a file, found by their lengths. The file is mapped, so that only what is looked at is read."""

    def __init__(self, path: Path) -> None:
        """Raise LogError for a file that is no sequence of whole records."""
        self.path = path
        try:
            check_regular(path)
            with path.open("rb") as file:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
                # Fields are far apart: what lies behind one is not read ahead.
                mapped.madvise(mmap.MADV_RANDOM)
                self._bytes = memoryview(mapped)
        except (OSError, ValueError) as error:  # ValueError: an empty file
            raise fault(path, f"the file cannot be read ({error})", REMEDY) from error
        self._places = self._index()

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, number: int) -> memoryview:
        start, length = self._places[number]
        return self._bytes[start : start + length]

    def check(self) -> list[Problem]:
        """A problem for each record whose bytes do not have their checksum."""
        problems = []
        for number, (start, length) in enumerate(self._places):
            (told,) = struct.unpack_from("<I", self._bytes, start + length)
            if told != masked_crc32c(self[number]):
                message = f"the bytes of record {number} do not have the checksum that is stored with them"
                problems.append(Problem(self.path, message, REMEDY))
        return problems

    def _index(self) -> list[tuple[int, int]]:
        places: list[tuple[int, int]] = []
        place, end = 0, len(self._bytes)
        while place < end:
            what = f"record {len(places)}, at byte {place}"
            if end - place < _HEADER:
                raise fault(self.path, f"the file ends within the length of {what}", REMEDY)
            length, told = struct.unpack_from("<QI", self._bytes, place)
            if told != masked_crc32c(self._bytes[place : place + 8]):
                raise fault(self.path, self._disorder(what), REMEDY)
            if length > end - place - _HEADER - _FOOTER:
                message = f"{what}, says that it has {length} bytes, but {end - place - _HEADER} are left of the file"
                raise fault(self.path, message, REMEDY)
            if len(places) == _MAX_RECORDS:
                raise fault(self.path, f"the file has more than {_MAX_RECORDS} records, a segment has 200", REMEDY)
            places.append((place + _HEADER, length))
            place += _HEADER + length + _FOOTER
        return places

    def _disorder(self, what: str) -> str:
        if self._bytes[:2] == _GZIP:
            return "the file is packed by gzip: unpack it first"
        return f"the length of {what}, does not have the checksum that is stored with it: this is no TFRecord file"


def masked_crc32c(data: bytes | memoryview) -> int:
    """Return the checksum of a TFRecord: CRC-32C, rotated and offset.

    >>> hex(masked_crc32c(b"123456789"))  # the CRC is 0xe3069283
    '0xc78ab0e5'
    """
    crc = google_crc32c.value(bytes(data))
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
"""Wire types: an integer in groups of 7 bits, the lowest first; eight bytes; a length and as many bytes; four bytes."""
_MAX_BITS = 64
_SHIFT = 7


class Message:
    """The fields of a message by their numbers. All methods raise LogError, naming file and field, for broken ones.

    A field is a key, field number * 8 + wire type, and a value. Numbers of a repeated field may stand in one field of
    bytes ("packed"). Nothing is copied, and no length is believed that the message does not have.
    """

    def __init__(self, data: memoryview, path: Path, what: str) -> None:
        """``what``: the message in words, for errors."""
        self.path, self.what = path, what
        self._fields: dict[int, list[tuple[int, int | memoryview]]] = {}
        for number, wire, value in self._read(data):
            self._fields.setdefault(number, []).append((wire, value))

    def error(self, message: str) -> LogError:
        return fault(self.path, f"{self.what}: {message}", REMEDY)

    def __contains__(self, number: int) -> bool:
        return number in self._fields

    def integer(self, number: int, default: int | None = None) -> int:
        wire, value = self._last(number, default)
        if wire != _VARINT or not isinstance(value, int):
            raise self.error(f"field {number} is no integer")
        return value - 2**64 if value >= 2**63 else value

    def number(self, number: int, default: float | None = None) -> float:
        """A float or a double."""
        if default is not None and number not in self:
            return default
        wire, value = self._last(number)
        if wire not in (_EIGHT, _FOUR) or isinstance(value, int):
            raise self.error(f"field {number} is no number with a fraction")
        return struct.unpack("<d" if wire == _EIGHT else "<f", value)[0]

    def doubles(self, number: int) -> np.ndarray:
        """A repeated field of doubles, packed or not; empty where there is none."""
        return self._array(number, _EIGHT, "<f8", "doubles")

    def floats(self, number: int) -> np.ndarray:
        """As ``doubles``, of single precision."""
        return self._array(number, _FOUR, "<f4", "floats")

    def _array(self, number: int, single: int, kind: str, words: str) -> np.ndarray:
        parts = [np.zeros(0, kind)]
        for wire, value in self._fields.get(number, ()):
            if wire not in (single, _BYTES) or isinstance(value, int) or len(value) % parts[0].itemsize:
                raise self.error(f"field {number} holds no {words}")
            parts.append(np.frombuffer(value, kind))
        return np.concatenate(parts)

    def integers(self, number: int) -> list[int]:
        """A repeated field of integers, packed or not."""
        found: list[int] = []
        for wire, value in self._fields.get(number, ()):
            if wire == _VARINT and isinstance(value, int):
                found.append(value)
            elif wire == _BYTES and isinstance(value, memoryview):
                place = 0
                while place < len(value):
                    one, place = self._varint(value, place)
                    found.append(one)
            else:
                raise self.error(f"field {number} holds no integers")
        return found

    def data(self, number: int) -> memoryview:
        """The bytes of a field, none where it is absent."""
        wire, value = self._last(number, memoryview(b""))
        if wire != _BYTES or not isinstance(value, memoryview):
            raise self.error(f"field {number} holds no bytes")
        return value

    def text(self, number: int) -> str:
        try:
            return bytes(self.data(number)).decode()
        except UnicodeDecodeError as error:
            raise self.error(f"field {number} is no text") from error

    def message(self, number: int, what: str) -> "Message":
        """The message in a field; an empty one where the field is absent."""
        return Message(self.data(number), self.path, f"{self.what}, {what}")

    def messages(self, number: int, what: str) -> Iterator["Message"]:
        for place, (wire, value) in enumerate(self._fields.get(number, ())):
            if wire != _BYTES or not isinstance(value, memoryview):
                raise self.error(f"field {number} holds no message")
            yield Message(value, self.path, f"{self.what}, {what} {place}")

    def _last(self, number: int, default: int | memoryview | None = None) -> tuple[int, int | memoryview]:
        """Of a field that stands more than once the last one counts."""
        if number in self._fields:
            return self._fields[number][-1]
        if default is None:
            raise self.error(f"field {number} is missing")
        return (_VARINT if isinstance(default, int) else _BYTES), default

    def _read(self, data: memoryview) -> Iterator[tuple[int, int, int | memoryview]]:
        place = 0
        while place < len(data):
            key, place = self._varint(data, place)
            number, wire = key >> 3, key & 7
            if wire == _VARINT:
                value, place = self._varint(data, place)
                yield number, wire, value
                continue
            if wire == _BYTES:
                length, place = self._varint(data, place)
            elif wire in (_EIGHT, _FOUR):
                length = 8 if wire == _EIGHT else 4
            else:
                raise self.error(f"the field at byte {place} has the wire type {wire}, which Waymo's messages lack")
            if number == 0 or length > len(data) - place:
                raise self.error(f"field {number} says {length} bytes, {len(data) - place} are left of the message")
            yield number, wire, data[place : place + length]
            place += length

    def _varint(self, data: memoryview, place: int) -> tuple[int, int]:
        value = shift = 0
        while place < len(data) and shift < _MAX_BITS:
            byte = data[place]
            value |= (byte & 0x7F) << shift
            place, shift = place + 1, shift + _SHIFT
            if byte < 0x80:
                return value & (2**64 - 1), place
        raise self.error(f"an integer has no end within {place} bytes")


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


class RecordSegment(Segment):
    """Lengths tell where the parts of a frame lie; the parts are decoded when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Raise LogError for a file whose frames cannot be told apart."""
        self.source = self.calibration_file = self.image_file = path
        self.box_file = self.lidar_file = self.label_file = path
        self._records = Records(path)
        if not len(self._records):
            raise fault(path, "the file has no records", REMEDY)
        self._frames = [Message(self._records[n], path, f"frame {n}") for n in range(len(self._records))]
        context = self._frames[0].message(CONTEXT, "context")
        self.name = context.text(1)
        self.cameras, self.lidars = read_cameras(context), read_lidars(context)
        self.stamps = [frame.integer(STAMP) for frame in self._frames]
        for frame in self._frames[1:]:
            other = frame.message(CONTEXT, "context").text(1)
            if other != self.name:
                raise frame.error(f"it is of the segment {other!r}, the frames before are of {self.name!r}")

    def world_from_vehicle(self, frame: int) -> Float64[Tensor, "4 4"]:
        pose = self._frames[frame].message(POSE, "pose")
        return transform(pose.doubles(1), self.source, pose.what)

    def images(self, frame: int) -> Mapping[str, ImageMotion]:
        images = self._images(frame)
        return {name: read_motion(image) for name, image in images.items() if len(image.data(JPEG))}

    def jpeg(self, frame: int, camera: str) -> bytes:
        return bytes(self._images(frame)[camera].data(JPEG))

    def boxes(self, frame: int) -> Sequence[BoxLabel]:
        return [read_label(label) for label in self._frames[frame].messages(LABELS, "laser_labels")]

    @cached_property
    def has_boxes(self) -> bool:
        return any(LABELS in frame for frame in self._frames)

    @cached_property
    def labelled(self) -> frozenset[tuple[int, str]]:
        return frozenset(
            (frame, name)
            for frame in range(len(self._frames))
            for name, image in self._images(frame).items()
            if len(image.message(PANOPTIC, "camera_segmentation_label").data(2))
        )

    def panoptic(self, frame: int, camera: str) -> tuple[bytes, int]:
        label = self._images(frame)[camera].message(PANOPTIC, "camera_segmentation_label")
        return bytes(label.data(2)), label.integer(1)

    def has_returns(self, frame: int) -> bool:
        return any(len(first.data(2)) for _, first, _ in self._lasers(frame))

    def returns(self, frame: int) -> Sequence[Returns]:
        found = []
        for name, first, second in self._lasers(frame):
            images = [range_image(image, 2, 4) for image in (first, second)]
            poses = range_image(first, 4, 6) if name == "TOP" else None
            images = [image for image in images if image is not None]
            if images:
                found.append(returns_of(name, images, poses))
        return found

    def files(self) -> LogFiles:
        return LogFiles(recorded=[self.source])

    def check_files(self) -> list[Problem]:
        return self._records.check()

    def _images(self, frame: int) -> dict[str, Message]:
        images = self._frames[frame].messages(IMAGES, "images")
        return {named(image, CAMERAS): image for image in images}

    def _lasers(self, frame: int) -> list[tuple[str, Message, Message]]:
        """Name, first and second return of the lidars that are told by name."""
        lasers = self._frames[frame].messages(LASERS, "lasers")
        return [
            (named(one, LIDARS), one.message(2, "ri_return1"), one.message(3, "ri_return2"))
            for one in lasers
            if NAME in one
        ]
