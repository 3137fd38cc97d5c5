"""A hash that tells logs apart by the files that are read, without reading a data set."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

_END = 4096
_CHUNK = 1 << 20


@dataclass(frozen=True)
class LogFiles:
    """What a reader reads of a log. A file that is not there counts as absent, which a hash tells apart too."""

    described: Sequence[Path] = ()
    """Poses, calibrations, boxes, stamps: read at once, and hashed byte by byte."""
    recorded: Sequence[Path] = ()
    """Images, masks, points: decoded when they are asked for. Name, size, and the first and last 4 kB of each count."""


def hash_files(root: Path, files: LogFiles) -> str:
    """12 hexadecimal digits of the SHA-256 over the files in order of their names relative to ``root``.

    Equal for the same files in another place, whatever lies beside them, and in whatever order they are given.
    """
    digest = hashlib.sha256()
    whole = set(files.described)
    names = {path.relative_to(root).as_posix(): path for path in (*files.described, *files.recorded)}
    for name in sorted(names):
        path = names[name]
        if path.is_file():
            digest.update(f"{name} {path.stat().st_size}\n".encode())
            for part in _whole(path) if path in whole else _ends(path):
                digest.update(part)
    return digest.hexdigest()[:12]


def _whole(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while part := file.read(_CHUNK):
            yield part


def _ends(path: Path) -> Iterator[bytes]:
    """The first and the last 4 kB of a file, all of it where it has no more than both."""
    with path.open("rb") as file:
        yield file.read(_END)
        file.seek(max(_END, path.stat().st_size - _END))
        yield file.read()
