"""Ways to break files, and what must be said then."""

import io
import random
import shutil
import struct
import zlib
from collections.abc import Callable, Collection
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet
from PIL import Image

from sparsestreet.data.problems import LogError
from sparsestreet.data.recording import RecordedReader

Damage = Callable[[Path], object]


def replaced(old: str, new: str, count: int = 1) -> Damage:
    """Something else in the text; that it was there is asserted."""

    def damage(path: Path) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, count))

    return damage


def word(number: int, new: str) -> Damage:
    """Another word at this place of a file of one line."""

    def damage(path: Path) -> None:
        words = path.read_text().split(" ")
        path.write_text(" ".join([*words[:number], new, *words[number + 1 :]]))

    return damage


def line(number: int, new: str | None) -> Damage:
    """Another line of this number; None: the file ends before it."""

    def damage(path: Path) -> None:
        lines = path.read_text().splitlines()
        path.write_text(
            "\n".join(lines[:number] if new is None else [*lines[:number], new, *lines[number + 1 :]]) + "\n"
        )

    return damage


def written(content: bytes) -> Damage:
    return lambda path: path.write_bytes(content)


def gone(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def cut(path: Path) -> None:
    """The second half is missing."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def long(size: int) -> Damage:
    """Of this many bytes, none of which is on the disk."""

    def damage(path: Path) -> None:
        with path.open("wb") as file:
            file.truncate(size)

    return damage


def png(width: int, height: int, mode: str = "RGB") -> Damage:
    return lambda path: Image.new(mode, (width, height)).save(path)


def bomb(path: Path) -> None:
    """A PNG whose header announces 60000 x 60000 pixels; the rest of the file stays."""
    buffer = io.BytesIO()
    Image.new("RGB", (32, 24)).save(buffer, "PNG")
    content = bytearray(buffer.getvalue())
    content[16:24] = struct.pack(">II", 60_000, 60_000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)


LAUGHS = '<!DOCTYPE a [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'


def daily(faults: Collection[str], *chosen: str) -> list[ParameterSet]:
    """Return all faults as parameters of a test; those that are not chosen are left to make test-all."""
    assert set(chosen) <= set(faults)
    return [pytest.param(one, id=one, marks=() if one in chosen else pytest.mark.slow) for one in faults]


def assert_found(reader: RecordedReader, path: Path, said: str) -> None:
    """One problem that names the file and says what is wrong; the log is not read, or ends where the file is."""
    problems = reader.check()
    assert [problem.path for problem in problems] == [path]
    assert said in problems[0].message
    assert problems[0].remedy
    with pytest.raises(LogError):
        log = reader.read()
        list(log.frames)
        list(log.sweeps)


def refusals(read: Callable[[Path], object], path: Path, content: bytes, *, count: int, seed: int) -> int:
    """How many of ``count`` files, with some bytes changed, cut out and put in, raise LogError; nothing else may."""
    source, refused = random.Random(seed), 0
    for _ in range(count):
        broken = bytearray(content)
        for _ in range(source.randint(1, 8)):
            at = source.randrange(len(broken))
            broken[at : at + source.randint(0, 3)] = source.randbytes(source.randint(0, 3))
        path.write_bytes(broken)
        try:
            read(path)
        except LogError:
            refused += 1
    return refused
