"""Where the records of a TFRecord file lie. A record is its length (8 bytes), a checksum of that (4 bytes), its bytes,
and a checksum of these (4 bytes)."""

import mmap
import struct
from pathlib import Path

import google_crc32c

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import Problem, fault
from sparsestreet.data.waymo.segment import REMEDY

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
