"""Every damage of a file of version 1 is one clear error that names the file and what is wrong in it."""

import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from sparsestreet.data.problems import LogError
from sparsestreet.data.waymo import WaymoReader
from sparsestreet.data.waymo.v1 import Records, RecordSegment, masked_crc32c
from tests.conftest import unchecked
from tests.data.damage import daily
from tests.data.waymo import records
from tests.data.waymo.drive import Drive, encoded
from tests.data.waymo.messages import edited
from tests.data.waymo.records import data, double, doubles, floats, integer

FRAMES = 2


@pytest.fixture(scope="module")
def messages() -> list[bytes]:
    drive = Drive(num_frames=FRAMES)
    return [records.message(drive, frame) for frame in range(FRAMES)]


def field(path: Sequence[int | tuple[int, int]], new: bytes, frame: int = 1) -> Callable[[list[bytes]], list[bytes]]:
    """Replaces a field of a frame; calibrations are read from the first one."""

    def change(messages: list[bytes]) -> list[bytes]:
        return [edited(one, path, new) if place == frame else one for place, one in enumerate(messages)]

    return change


def calibration(path: Sequence[int | tuple[int, int]], new: bytes) -> Callable[[list[bytes]], list[bytes]]:
    return field([1, *path], new, frame=0)


NAN = float("nan")
POSE = np.eye(4)
BOMB = zlib.compress(bytes(200 * 2**20), 9)
FIELDS = {
    "no stamp": (field([2], b""), "frame 1: field 2 is missing"),
    "stamp is text": (field([2], data(2, "soon")), "frame 1: field 2 is no integer"),
    "stamps go back": (field([2], integer(2, 5)), "frames 0 and 1 do not increase"),
    "another segment": (field([1, 1], data(1, "other")), "frame 1: it is of the segment 'other'"),
    "pose of 15 numbers": (field([3], data(3, doubles(1, [0.0] * 15))), "frame 1, pose has 15 numbers, not 16"),
    "pose of bytes": (field([3], data(3, data(1, b"abc"))), "frame 1, pose: field 1 holds no doubles"),
    "eight intrinsics": (calibration([(2, 0), 2], doubles(2, [1.0] * 8)), "camera FRONT has the intrinsics"),
    "lens": (calibration([(2, 0), 2], doubles(2, [30, 30, 16, 12, 0, 0, 1, 1, 0])), "no inverse"),
    "absurd width": (calibration([(2, 0), 4], integer(4, 2**40)), f"images of {2**40}x24 pixels"),
    "direction": (calibration([(2, 0), 6], integer(6, 9)), "rolling_shutter_direction 9"),
    "a ninth camera": (calibration([(2, 0), 1], integer(1, 9)), "it is of number 9, not one of"),
    "mount": (calibration([(2, 0), 3], b""), "extrinsic has 0 numbers, not 16"),
    "beams in disorder": (calibration([(3, 0), 2], doubles(2, [0.1, 0, 0.2, 0.3, 0.4, 0.5])), "no ascending angles"),
    "beams beyond": (calibration([(3, 0), 2], doubles(2, [0.1, 0.2, 0.3, 0.4, 0.5, 9])), "up to a quarter turn"),
    "limits in disorder": (calibration([(3, 1), 3], double(3, 1.0)), "no ascending angles"),
    "a beam too few": (calibration([(3, 0), 2], doubles(2, [0.1, 0.2, 0.3, 0.4, 0.5])), "5 inclinations"),
    "uncalibrated lidar": (calibration([(3, 1), 1], integer(1, 5)), "lidar FRONT has range images, but no calibration"),
    "velocity": (field([(4, 1), 4, 1], double(1, NAN)), "frame 1, images 1 has velocities or times that are NaN"),
    "no trigger": (field([(4, 1), 7], b""), "frame 1, images 1: field 7 is missing"),
    "read out before": (field([(4, 1), 8], double(8, 1e9)), "no camera takes an image so"),
    "pose of another hour": (field([(4, 1), 5], double(5, 1e9)), "no camera takes an image so"),
    "torn image": (
        field([(4, 1), 2], data(2, b"\x89PNG\r\n\x1a\nxx")),
        "the image of FRONT at frame 1 cannot be decoded",
    ),
    "image of another size": (
        field([(4, 1), 2], data(2, encoded(np.zeros((8, 9, 3), np.uint8)))),
        "the image of FRONT at frame 1 is 9x8, its calibration is for 32x24",
    ),
    "box with NaN": (field([(6, 0), 1, 1], double(1, NAN)), "no box can be so"),
    "flat box": (field([(6, 0), 1, 6], double(6, 0)), "no box can be so"),
    "class": (field([(6, 0), 3], integer(3, 77)), "has the type 77"),
    "nameless box": (field([(6, 0), 4], b""), "has no id"),
    "seen by nobody": (field([(6, 0), 11], data(11, "ROOF")), "the camera 'ROOF' of its camera_synced_box"),
    "range image": (field([(5, 0), 2, 2], data(2, b"no zlib")), "lasers 0, ri_return1: field 2 cannot be unpacked"),
    "torn range image": (
        field([(5, 0), 2, 2], data(2, floats(np.ones((6, 60, 4)))[:-9])),
        "field 2 ends within its packed bytes",
    ),
    "bomb": (field([(5, 0), 2, 2], data(2, BOMB)), "unpacks to more than 64 MiB"),
    "three channels": (field([(5, 0), 2, 2], data(2, floats(np.ones((6, 60, 3))))), "the shape [6, 60, 3]"),
    "too few numbers": (
        field([(5, 0), 2, 2], data(2, zlib.compress(data(1, bytes(16)) + data(2, data(1, b"\x06\x3c\x04"))))),
        "it has 4 numbers for the shape [6, 60, 4]",
    ),
    "infinite range": (
        field([(5, 0), 2, 2], data(2, floats(np.full((6, 60, 4), np.inf)))),
        "NaN, infinite or more than",
    ),
    "poses of other pixels": (field([(5, 0), 2, 4], data(4, floats(np.ones((6, 9, 6))))), "poses of (6, 9)"),
    "divisor": (field([(4, 1), 10, 1], integer(1, 0)), "has the divisor 0"),
    "wire type": (field([3], b"\x1b"), "frame 1: the field at byte"),
    "field 0": (field([3], data(0, "x")), "frame 1: field 0 says"),
    "length beyond the message": (field([8], b"\x42\xff\xff\xff\xff\x0f"), "frame 1: field 8 says 4294967295 bytes"),
    "endless number": (field([8], b"\x40" + b"\xff" * 11), "frame 1: an integer has no end"),
    "no images": (
        lambda messages: [edited(edited(one, [(4, 0)], b""), [(4, 0)], b"") for one in messages],
        "no images",
    ),
}


@pytest.mark.parametrize(
    "name", daily(FIELDS, "pose of bytes", "box with NaN", "image of another size", "bomb", "torn range image")
)
def test_a_damaged_field(name, messages, tmp_path):
    change, said = FIELDS[name]
    path = records.write(tmp_path / "segment-1.tfrecord", change(messages))
    problems = WaymoReader(root=tmp_path).check()
    assert [problem.path for problem in problems] == [path]
    assert said in problems[0].message
    assert problems[0].remedy


def cut(length: int) -> Callable[[bytes], bytes]:
    return lambda content: content[:length]


def with_length(length: int) -> Callable[[bytes], bytes]:
    head = struct.pack("<Q", length)
    return lambda content: head + struct.pack("<I", records.masked(head)) + content[12:]


FILES = {
    "empty": (lambda content: b"", "cannot be read"),
    "cut in a length": (cut(7), "ends within the length of record 0, at byte 0"),
    "cut in a record": (cut(500), "record 0, at byte 0, says that it has"),
    "absurd length": (with_length(2**60), f"says that it has {2**60} bytes"),
    "absurd length, wrong checksum": (lambda content: b"\xff" * 8 + content[8:], "this is no TFRecord file"),
    "text": (lambda content: b"version https://git-lfs.github.com/spec/v1", "this is no TFRecord file"),
    "packed": (gzip.compress, "packed by gzip"),
    "a flipped bit of an image": (
        lambda content: content[:-3000] + bytes([content[-3000] ^ 1]) + content[-2999:],
        "the bytes of record 1 do not have the checksum",
    ),
    "no end of records": (lambda content: records.record(b"") * 2_001, "more than 2000 records"),
}


@pytest.mark.parametrize("name", daily(FILES, "cut in a record", "text", "a flipped bit of an image"))
def test_a_damaged_file(name, messages, tmp_path):
    change, said = FILES[name]
    path = records.write(tmp_path / "segment-1.tfrecord", messages)
    path.write_bytes(change(path.read_bytes()))
    problem = WaymoReader(root=tmp_path).check()[0]
    assert problem.path == path
    assert said in problem.message


def test_a_bomb_takes_no_more_memory_than_a_range_image_may(messages, tmp_path):
    records.write(tmp_path / "segment-1.tfrecord", FIELDS["bomb"][0](messages))
    sweep = WaymoReader(root=tmp_path).recording().sweeps[1]
    tracemalloc.start()
    with pytest.raises(LogError, match="64 MiB"):
        sweep.read()
    # 200 MiB are packed. zlib doubles its buffer as it grows.
    assert tracemalloc.get_traced_memory()[1] < 150 * 2**20
    tracemalloc.stop()


@pytest.mark.slow
def test_mutated_messages_are_read_or_refused(messages, tmp_path):
    """200 files with a few bytes changed, lengths right again: no other error than LogError."""
    generator, refused = np.random.default_rng(0), 0
    for number in range(200):
        payload = bytearray(messages[1])
        for place in generator.integers(0, len(payload), generator.integers(1, 6)):
            payload[place] = generator.integers(256)
        path = records.write(tmp_path / f"{number}.tfrecord", [])
        # The checksum of the bytes is not looked at here.
        head = struct.pack("<Q", len(payload))
        path.write_bytes(head + struct.pack("<I", masked_crc32c(head)) + bytes(payload) + bytes(4))
        try:
            with unchecked():
                segment = RecordSegment(path)
                _ = segment.world_from_vehicle(0), segment.images(0), segment.boxes(0), segment.returns(0)
                for frame, camera in segment.labelled:
                    segment.panoptic(frame, camera)
        except LogError:
            refused += 1
        path.unlink()
    assert 40 < refused < 200


def test_a_record_is_not_read_to_find_the_next(tmp_path):
    """A file of 8 GB, all of it a hole, is indexed at once."""
    head = struct.pack("<Q", 2**32)
    path = tmp_path / "1.tfrecord"
    with path.open("wb") as file:
        for number in range(2):
            file.seek(number * (2**32 + 16))
            file.write(head + struct.pack("<I", records.masked(head)))
        file.truncate(2 * (2**32 + 16))
    assert len(Records(Path(path))) == 2
