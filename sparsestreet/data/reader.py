"""What every data set offers: to be checked, and to be read."""

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast, get_args

from sparsestreet.data.log import DrivingLog, SceneExtent
from sparsestreet.data.problems import Problem


@dataclass(frozen=True)
class FolderSignature:
    """Files or folders of a data set, as patterns below its root; any one of them tells."""

    patterns: Sequence[str]
    depth: int = 0
    """Folders below the root that may hold them instead."""

    def found_in(self, root: Path) -> Path | None:
        """What tells, below ``root``; None where there is nothing of it."""
        return next((path for found in self._searched(root) if (path := min(found, default=None))), None)

    def tell_of(self, folder: Path, root: Path) -> bool:
        """Whether something below ``root`` that tells is ``folder``, or in it, or around it."""
        every = (path for found in self._searched(root) for path in found)
        return any(path.is_relative_to(folder) or folder.is_relative_to(path) for path in every)

    def _searched(self, root: Path) -> Iterator[Iterator[Path]]:
        for depth in range(self.depth + 1):
            for pattern in self.patterns:
                yield root.glob("*/" * depth + pattern)

    def __str__(self) -> str:
        below = f", up to {self.depth} folders below" if self.depth else ""
        return " or ".join(self.patterns) + below


@dataclass(frozen=True)
class UnreadFormat:
    """A data set that no reader reads."""

    name: str
    marks: FolderSignature
    remedy: str
    """What to do instead."""


UNREAD = (
    UnreadFormat(
        "NVIDIA's PhysicalAI-AV",
        FolderSignature(("*.egomotion*.parquet", "*.chunk_*.parquet"), depth=1),
        "videos and packed point clouds would need a video decoder and DracoPy: write images, poses and points as "
        "data=rig_json, which has NVIDIA's f-theta lens (docs/datasets/rig_json.md)",
    ),
    UnreadFormat(
        "NVIDIA's NCore",
        FolderSignature(("*.zarr.itar",), depth=1),
        "its containers would need the package nvidia-ncore: write what that reads as data=rig_json "
        "(docs/datasets/rig_json.md)",
    ),
)
"""Recognized, so that nobody looks for a mistake of their own."""


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


class LogReader(ABC):
    """A log on disk and the part of it that is wanted; both verbs look at that part only."""

    marks: ClassVar[FolderSignature | None] = None
    """How ``data=auto`` knows a folder that it reads; None: it is chosen by its name alone."""

    @property
    @abstractmethod
    def folder(self) -> Path:
        """Where the log lies."""

    @abstractmethod
    def check(self) -> list[Problem]:
        """Everything to repair before ``read``, down to the pixels; ValueError where the wanted part is not there."""

    @abstractmethod
    def read(self) -> DrivingLog:
        """The log, its pixels and points still on disk. Raises LogError where it needs repair, and ValueError as
        ``check`` does; a file that turns out to be broken when it is decoded raises LogError then."""

    def files(self) -> LogFiles:
        """The files that tell this log from others: by default all below ``folder``, as recorded ones.

        A reader of one scene out of a data set, or of some frames and cameras, names those that it reads.
        """
        return LogFiles(recorded=[path for path in self.folder.rglob("*") if path.is_file()])

    def identity(self) -> str | None:
        """Hash of what is read and how: ``data_hash``, size and time of the last change of each file, and the settings.

        Unlike ``data_hash`` it changes with any byte, and with the place. None for a reader from outside of this
        package: nobody knows when its code changes.
        """
        if not type(self).__module__.startswith("sparsestreet."):
            return None
        states = sorted((str(path), path.stat()) for path in self.watched() if path.is_file())
        settings = [(entry.name, repr(getattr(self, entry.name))) for entry in fields(cast(Any, self))]
        said = [
            type(self).__name__,
            self.data_hash(),
            [setting for setting in settings if setting[0] != "cache_mb"],  # time, not content
            [(name, state.st_size, state.st_mtime_ns) for name, state in states],
        ]
        return hashlib.sha256(json.dumps(said).encode()).hexdigest()

    def watched(self) -> Iterator[Path]:
        """All files that are read, those beside the log too; some may not be there."""
        files = self.files()
        yield from (*files.described, *files.recorded)

    def data_hash(self) -> str:
        """12 hexadecimal digits that are equal for the same log, wherever it lies (``hash_files``)."""
        return hash_files(self.folder, self.files())


Name = TypeVar("Name", str, int)

_SHOWN = 8
"""Names that an error lists."""


def listed(names: Sequence[str]) -> str:
    """What a choice can be, for the error of one that is not there: the first few names, and how many there are.

    >>> listed(["a", "b"]), listed([])
    ('a, b', 'none')
    >>> listed(list("abcdefghij"))
    'a, b, c, d, e, f, g, h, ... (10 in all)'
    """
    more = f", ... ({len(names)} in all)" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more or "none"


def check_region(extent: str, lidar_ahead: Sequence[float | int] | None) -> None:
    """Raise ValueError for a scene's box that is none of ``SceneExtent``, and for distances that are no interval."""
    if extent not in get_args(SceneExtent):
        raise ValueError(f"extent must be one of {', '.join(get_args(SceneExtent))}, got {extent!r}")
    if lidar_ahead is not None and not (len(lidar_ahead) == 2 and lidar_ahead[0] < lidar_ahead[1]):
        raise ValueError(f"lidar_ahead needs a least and a larger distance, got {lidar_ahead}: say [-2, 80]")


def frame_window(num_frames: int, first_frame: int, last_frame: int, root: Path) -> range:
    """Frames first_frame .. last_frame, included; -1: to the end. Raises ValueError for frames that ``root`` lacks."""
    last = num_frames - 1 if last_frame == -1 else last_frame
    if not 0 <= first_frame <= last < num_frames:
        raise ValueError(f"frames {first_frame} to {last_frame} are not within the log's 0 to {num_frames - 1}: {root}")
    return range(first_frame, last + 1)


def chosen_cameras(found: Sequence[Name], wanted: Sequence[Name] | None, root: Path) -> tuple[Name, ...]:
    """The wanted ones of a log's cameras, in their order; None: all. Raises ValueError for any that ``root`` lacks."""
    chosen = tuple(found) if wanted is None else tuple(wanted)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(found):
        raise ValueError(f"cameras {list(chosen)} must be different ones of the log's {list(found)}: {root}")
    return chosen
