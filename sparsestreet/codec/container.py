"""A file of frames: each with a tag, its sizes, a checksum and zstd's bytes; written and read one after the other.

    magic 8 bytes | version u16 | frames ... | a frame "END "

    frame: tag 4 bytes | bytes stored u32 | bytes unpacked u32 | CRC-32 u32 of all that | zstd frames (RFC 8878)

Little endian. The frame "END " counts the others, so a file that was cut between two frames is known as such.
"""

import io
import struct
import zlib
from collections.abc import Sequence
from types import ModuleType, TracebackType

FREE = 2**28
"""Bytes that any file may unpack to: 256 MiB."""
PER_BYTE = 256
"""Bytes more for each byte of the file. A street needs about 15; rows that are all the same need far more."""


class Budget:
    """Counts what a file unpacks to.

    >>> Budget(10).take(100)
    >>> Budget(10).take(10**15)
    Traceback (most recent call last):
    ...
    ValueError: the file has 10 bytes and claims 1000000000000000 unpacked, above its limit of 268438016: it is damaged
    """

    def __init__(self, file_size: int) -> None:
        self._file_size, self._taken = file_size, 0

    @property
    def limit(self) -> int:
        """Bytes, all in all."""
        return FREE + PER_BYTE * self._file_size

    def take(self, count: int) -> None:
        """Ask for so many bytes more, before they are allocated. Raises ValueError beyond the limit."""
        self._taken += count
        if count < 0 or self._taken > self.limit:
            raise ValueError(
                f"the file has {self._file_size} bytes and claims {self._taken} unpacked, above its limit of "
                f"{self.limit}: it is damaged"
            )


MAGIC = b"\x89STREET\n"
"""The first byte is no text, the last one changes where a program takes the file for text."""
VERSION = 1
MAX_FRAME = 2**26
"""Bytes that a frame may unpack to."""
LEVEL = 19
"""Of zstd: 3 % less than level 12."""

_FRAME = struct.Struct("<4sIII")
_SIZES = struct.Struct("<4sII")
_VERSION = struct.Struct("<H")
_END = b"END "


class FrameWriter:
    """Writes frames into a file that is open for bytes; the context's end writes the last one."""

    def __init__(self, file: io.BufferedIOBase) -> None:
        self._file, self._count = file, 0
        self._compressor = _zstandard().ZstdCompressor(level=LEVEL, write_checksum=False)
        file.write(MAGIC + _VERSION.pack(VERSION))

    def __enter__(self) -> "FrameWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is None:
            self._write(_END, [struct.pack("<I", self._count)])

    def write(self, tag: str, pieces: Sequence[bytes]) -> int:
        """Write a frame and return the bytes that it takes; statistics of a piece serve this piece alone.

        Raises ValueError for more than ``MAX_FRAME`` bytes.
        """
        self._count += 1
        return self._write(tag.encode("ascii"), pieces)

    def _write(self, tag: bytes, pieces: Sequence[bytes]) -> int:
        unpacked = sum(map(len, pieces))
        if unpacked > MAX_FRAME:
            raise ValueError(f"a frame holds at most {MAX_FRAME} bytes, got {unpacked}: write several")
        stored = b"".join(self._compressor.compress(piece) for piece in pieces)
        sizes = _SIZES.pack(tag, len(stored), unpacked)
        self._file.write(sizes + struct.pack("<I", zlib.crc32(stored, zlib.crc32(sizes))) + stored)
        return _FRAME.size + len(stored)


class FrameReader:
    """Reads the frames of a file in order.

    Raises ValueError for whatever is no such file, damaged, of another version, or asks for more memory than its size
    allows; nothing is allocated before that is known.
    """

    def __init__(self, file: io.BufferedIOBase) -> None:
        self._file, self._count = file, 0
        self.budget = Budget(file.seek(0, io.SEEK_END))
        file.seek(0)
        self._decompressor = _zstandard().ZstdDecompressor(max_window_size=MAX_FRAME)
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it does not start as a .street does")
        (version,) = _VERSION.unpack(self._exactly(_VERSION.size))
        if version != VERSION:
            raise ValueError(f"it has version {version} of the format, this program reads {VERSION}: export it again")

    def read(self, tag: str) -> bytes:
        """Return the content of the next frame, which must have this tag."""
        self._count += 1
        return self._read(tag.encode("ascii"))

    def finish(self) -> None:
        """Read the last frame. Raises ValueError where frames are missing or bytes follow."""
        (count,) = struct.unpack("<I", self._read(_END))
        if count != self._count or self._file.read(1):
            raise ValueError(f"it has {count} parts by its own count, and {self._count} were read: it is damaged")

    def _read(self, wanted: bytes) -> bytes:
        head = self._exactly(_FRAME.size)
        tag, stored, unpacked, checksum = _FRAME.unpack(head)
        if tag != wanted:
            raise ValueError(f"a part {wanted.decode()!r} should follow, got {tag!a}: it is damaged")
        if unpacked > MAX_FRAME or stored > MAX_FRAME:
            raise ValueError(f"a part claims {max(unpacked, stored)} bytes, at most {MAX_FRAME} are allowed")
        self.budget.take(unpacked)
        content = self._exactly(stored)
        if zlib.crc32(content, zlib.crc32(head[: _SIZES.size])) != checksum:
            raise ValueError(f"the checksum of part {self._count} is wrong: bytes changed")
        return self._unpacked(content, unpacked)

    def _unpacked(self, content: bytes, size: int) -> bytes:
        # A stream, because zstd's frame has a size of its own, which decompress() would believe.
        try:
            with self._decompressor.stream_reader(content, read_across_frames=True) as stream:
                found = stream.read(size + 1)
        except _zstandard().ZstdError as error:
            raise ValueError(f"part {self._count} is no zstd frame ({error})") from error
        if len(found) != size:
            raise ValueError(f"part {self._count} does not unpack to the {size} bytes that it claims")
        return found

    def _exactly(self, count: int) -> bytes:
        found = self._file.read(count)
        if len(found) != count:
            raise ValueError(f"it ends {count - len(found)} bytes early: it was cut")
        return found


def _zstandard() -> ModuleType:
    try:
        import zstandard
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("a .street needs zstandard: pip install 'sparsestreet[street]'") from error
    return zstandard
