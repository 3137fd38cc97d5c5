"""A file of frames comes back whole, or it is refused: cut, changed, of another version, or too large for its bytes."""

import io
import struct
import sys
import tracemalloc
import zlib

import pytest
import zstandard

from sparsestreet.codec import container
from sparsestreet.codec.container import MAGIC, MAX_FRAME, VERSION, FrameReader, FrameWriter

CONTENTS = [b"", b"a", bytes(range(256)) * 40]


def written() -> bytes:
    file = io.BytesIO()
    with FrameWriter(file) as frames:
        for content in CONTENTS:
            frames.write("DATA", [content[:3], content[3:]])
    return file.getvalue()


def read(content: bytes) -> list[bytes]:
    frames = FrameReader(io.BytesIO(content))
    found = [frames.read("DATA") for _ in CONTENTS]
    frames.finish()
    return found


def frame(tag: bytes, stored: bytes, unpacked: int, claimed: int | None = None) -> bytes:
    sizes = struct.pack("<4sII", tag, len(stored) if claimed is None else claimed, unpacked)
    return sizes + struct.pack("<I", zlib.crc32(sizes + stored)) + stored


def file_of(*frames: bytes) -> bytes:
    return MAGIC + struct.pack("<H", VERSION) + b"".join(frames)


def test_frames_come_back():
    assert read(written()) == CONTENTS


def test_every_cut_is_refused():
    content = written()
    for length in range(len(content)):
        with pytest.raises(ValueError, match=r"cut|does not start"):
            read(content[:length])
    with pytest.raises(ValueError, match="3 parts by its own count"):
        read(content + b"x")


def test_every_changed_byte_is_refused():
    content = written()
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 0x11
        with pytest.raises(ValueError, match=r"^\w.*$"):
            read(bytes(changed))


def test_frames_that_were_left_out_or_stand_elsewhere():
    file = io.BytesIO()
    with FrameWriter(file) as frames:
        frames.write("HEAD", [b"x"])
    with pytest.raises(ValueError, match=r"a part 'DATA' should follow, got b'HEAD'"):
        FrameReader(io.BytesIO(file.getvalue())).read("DATA")
    reader = FrameReader(io.BytesIO(written()))
    reader.read("DATA")
    with pytest.raises(ValueError, match="a part 'END ' should follow"):
        reader.finish()


def test_another_version():
    content = written()
    with pytest.raises(ValueError, match=f"version {VERSION + 1} of the format, this program reads {VERSION}: export"):
        read(content[: len(MAGIC)] + struct.pack("<H", VERSION + 1) + content[len(MAGIC) + 2 :])


BOMB = zstandard.compress(bytes(2**28), 3)
"""256 MiB of zeros in 8 kB."""

HOSTILE = {
    "claims 4 GB": frame(b"DATA", zstandard.compress(b"a"), 2**32 - 1),
    "stores 4 GB": frame(b"DATA", b"abc", 1, claimed=2**32 - 1),
    "stores more than there is": frame(b"DATA", b"abc", 1, claimed=MAX_FRAME),
    "unpacks to more than it claims": frame(b"DATA", BOMB, 100),
    "unpacks to less than it claims": frame(b"DATA", zstandard.compress(b"a"), MAX_FRAME),
    "is no zstd": frame(b"DATA", b"abcdefgh", 8),
    "wants a window of 2 GB": frame(b"DATA", bytes.fromhex("28b52ffd00a8010000"), 8),
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE.keys())
def test_absurd_sizes_are_refused_with_little_memory(content: bytes):
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"^\w[^\n]*$"):
            read(file_of(content))
        assert tracemalloc.get_traced_memory()[1] < MAX_FRAME + 2**20
    finally:
        tracemalloc.stop()


def test_many_small_frames_that_unpack_to_much_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(container, "FREE", 2**20)
    zeros = zstandard.compress(bytes(2**19))
    reader = FrameReader(io.BytesIO(file_of(*[frame(b"DATA", zeros, 2**19)] * 9)))
    with pytest.raises(ValueError, match=r"the file has \d+ bytes and claims \d+ unpacked, above its limit of"):
        for _ in range(9):
            reader.read("DATA")


def test_a_frame_that_no_reader_would_take_is_not_written():
    frames = FrameWriter(io.BytesIO())
    with pytest.raises(ValueError, match=f"a frame holds at most {MAX_FRAME} bytes, got {MAX_FRAME + 1}"):
        frames.write("DATA", [bytes(MAX_FRAME), b"x"])


def test_without_zstandard(monkeypatch: pytest.MonkeyPatch):
    content = written()
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs zstandard: pip install 'sparsestreet\[street\]'"):
        read(content)
