"""Changes one field of a message that was written: to write what no sound file has."""

from collections.abc import Iterator, Sequence

from tests.data.waymo.records import varint

Path = Sequence[int | tuple[int, int]]


def edited(message: bytes, path: Path, new: bytes) -> bytes:
    """The message with ``new`` in the place of a whole field, its key included.

    ``path``: numbers of fields, from the outermost to the one that is replaced; (number, place) of a repeated one.
    """
    number, place = path[0] if isinstance(path[0], tuple) else (path[0], 0)
    out, seen = b"", 0
    for one, start, value, end in _fields(message):
        hit = one == number and seen == place
        seen += one == number
        if not hit:
            out += message[start:end]
        elif len(path) == 1:
            out += new
        else:
            inner = edited(message[value:end], path[1:], new)
            out += varint(number << 3 | 2) + varint(len(inner)) + inner
    assert seen > place, f"there is no field {path}"
    return out


def _fields(message: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Number of each field, where it begins, where its value does, and its end."""
    place = 0
    while place < len(message):
        start = place
        key, place = _varint(message, place)
        value = place
        if key & 7 == 0:
            _, place = _varint(message, place)
        elif key & 7 == 2:
            length, value = _varint(message, place)
            place = value + length
        else:
            place += 8 if key & 7 == 1 else 4
        yield key >> 3, start, value, place


def _varint(message: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (message[place] & 127) << shift
        place, shift = place + 1, shift + 7
        if message[place - 1] < 128:
            return value, place
