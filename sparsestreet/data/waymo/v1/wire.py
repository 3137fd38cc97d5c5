"""Messages of protocol buffers, as they lie in memory: numbered fields, no names.

A field is a key and a value. The key is field number * 8 + wire type. Wire types: 0 an integer in groups of 7 bits, the
lowest first; 1 eight bytes; 2 a length and as many bytes; 5 four bytes. Numbers of a repeated field may stand in one
field of wire type 2 ("packed"). Nothing is copied, and no length is believed that the message does not have.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.waymo.segment import REMEDY

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
_MAX_BITS = 64
_SHIFT = 7

Value = int | float | memoryview


class Message:
    """The fields of a message by their numbers. All methods raise LogError, naming file and field, for broken ones."""

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
        parts = []
        for wire, value in self._fields.get(number, ()):
            if wire not in (_EIGHT, _BYTES) or isinstance(value, int) or len(value) % 8:
                raise self.error(f"field {number} holds no doubles")
            parts.append(np.frombuffer(value, "<f8"))
        return np.concatenate(parts) if parts else np.zeros(0)

    def floats(self, number: int) -> np.ndarray:
        """As ``doubles``, of single precision."""
        parts = []
        for wire, value in self._fields.get(number, ()):
            if wire not in (_FOUR, _BYTES) or isinstance(value, int) or len(value) % 4:
                raise self.error(f"field {number} holds no floats")
            parts.append(np.frombuffer(value, "<f4"))
        return np.concatenate(parts) if parts else np.zeros(0, np.float32)

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

    def messages(self, number: int, what: str) -> "Iterator[Message]":
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
