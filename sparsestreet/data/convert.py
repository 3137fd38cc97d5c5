"""Write a log in the layout of a data set: file by file, so that what was interrupted goes on where it was."""

import errno
import json
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

from sparsestreet.data.log import DrivingLog

DESCRIPTION = "conversion.json"
"""Beside the files of the layout: what they were made of, and what was lost."""
FORMAT = 1
_TEMPORARY = ".conversion-*.tmp"


@dataclass(frozen=True)
class LogFile:
    """One file of a written log."""

    path: str
    """Below the log's folder, with ``/``; each once."""
    content: Callable[[], Iterable[bytes]]
    """Its bytes, in parts; not asked where the file is there already. Equal for the same log, whenever it is asked."""


class LogWriter(ABC):
    """Writes a log in the layout of a data set, such that the data set's reader gives it back."""

    @abstractmethod
    def files(self, log: DrivingLog) -> Iterator[LogFile]:
        """All files in the order in which they are written; images and points are decoded one file at a time.

        Raises ValueError, naming the object or camera, for a log that the layout cannot hold.
        """

    @abstractmethod
    def losses(self, log: DrivingLog) -> tuple[str, ...]:
        """What of this log the layout cannot hold, one sentence each, with numbers."""

    def notes(self, log: DrivingLog) -> tuple[str, ...]:
        """Return what was chosen, and what programs made for the layout will not take as it is, one sentence each."""
        return ()


Show = Callable[[Iterable[LogFile], int, str], Iterable[LogFile]]


@dataclass(frozen=True)
class Source:
    """The log that is converted, as its reader read it."""

    name: str
    data_hash: str
    reader: Mapping[str, Any] = field(default_factory=dict)
    """What was chosen of it, such as cameras, frames and width; the files are the data hash's."""


@dataclass(frozen=True)
class Conversion:
    """A finished one."""

    folder: Path
    files: int
    found: int
    """Those that an interrupted conversion had left."""
    bytes: int
    losses: tuple[str, ...]
    notes: tuple[str, ...] = ()


def partial_folder(folder: Path) -> Path:
    """Where the files are until all of them are there."""
    return folder.with_name(f".{folder.name}.partial")


def convert(
    log: DrivingLog, source: Source, writer: LogWriter, folder: Path, show: Show = lambda files, total, what: files
) -> Conversion:
    """Write all files into a partial folder beside ``folder``, which takes the name when it is whole.

    A file is written beside its place and renamed, so one that is there is whole and is not written again. The same
    call goes on with a partial folder of the same source, layout and settings.

    Args:
        log: of the source.
        source: tells whether a partial folder is of the same log.
        writer: of the layout.
        folder: not there, or empty.
        show: passes on the files that are to be written, their number and their name, and shows the progress.

    Raises ValueError for a log that the layout cannot hold, OSError where nothing can be written, or something else is
    in the way; then nothing was touched.
    """
    folder = folder.resolve()
    check_free(folder)
    files = checked(list(writer.files(log)))
    losses, notes = writer.losses(log), writer.notes(log)
    partial = partial_folder(folder)
    _take(partial, _description(log, source, writer, losses, notes), files)
    wanted = [file for file in files if not (partial / file.path).exists()]
    done = len(files) - len(wanted)
    try:
        for file in show(wanted, len(wanted), "files"):
            _write(partial, file.path, file.content())
            done += 1
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        message = f"the disk is full after {done} of {len(files)} files, which stay in {partial}: free some space, and "
        raise OSError(message + "give the same command to go on") from error
    size = sum((partial / file.path).stat().st_size for file in files)
    os.replace(partial, folder)
    return Conversion(folder, len(files), len(files) - len(wanted), size, losses, notes)


def check_free(folder: Path) -> None:
    """Raise OSError where something is in the way of a folder."""
    if folder.is_dir() and not any(folder.iterdir()):
        return
    if os.path.lexists(folder):
        what = "holds a finished conversion" if (folder / DESCRIPTION).is_file() else "is no empty folder"
        raise FileExistsError(f"{folder} {what}: name another place with to=..., or remove it")


def checked(files: Sequence[LogFile]) -> Sequence[LogFile]:
    """The files of a writer. Raises ValueError for paths that lead out of the folder, or come twice."""
    for file in files:
        path = PurePosixPath(file.path)
        if path.is_absolute() or ".." in path.parts or str(path) in (".", DESCRIPTION):
            raise ValueError(f"a writer names files below its folder, other than {DESCRIPTION}, got {file.path!r}")
    if files and (most := Counter(file.path for file in files).most_common(1)[0])[1] > 1:
        raise ValueError(f"a writer names each file once, got {most[0]!r} {most[1]} times")
    return files


def _description(
    log: DrivingLog, source: Source, writer: LogWriter, losses: tuple[str, ...], notes: tuple[str, ...]
) -> bytes:
    content = {
        "format": FORMAT,
        "version": version("sparsestreet"),
        "source": asdict(source),
        "layout": f"{type(writer).__module__}.{type(writer).__qualname__}",
        "settings": asdict(writer) if is_dataclass(writer) else {},
        "frames": log.num_frames,
        "cameras": log.camera_names or tuple(map(str, range(log.num_cameras))),
        "losses": losses,
        "notes": notes,
    }
    return json.dumps(content, indent=1, default=str).encode() + b"\n"


def _take(partial: Path, description: bytes, files: Sequence[LogFile]) -> None:
    """Make the partial folder, or go on with the one that is there. Raises OSError where it is of something else."""
    there = set(_files_below(partial)) if os.path.lexists(partial) else set()
    temporary = {path for path in there if path.parent == partial and path.match(_TEMPORARY)}
    there -= temporary
    label = partial / DESCRIPTION
    if there:
        found = label.read_bytes() if label.is_file() else b""
        if found != description:
            raise FileExistsError(f"{partial} {_difference(found, description)}: remove it, or name another place")
        foreign = there - {label, *(partial / file.path for file in files)}
        if foreign:
            raise FileExistsError(f"{min(foreign)} is no file of this conversion: remove {partial} to begin again")
    for path in temporary:
        path.unlink(missing_ok=True)
    if not there:
        try:
            _write(partial, DESCRIPTION, [description])
        except OSError as error:
            raise OSError(f"{partial} cannot be written ({error.strerror}): name another place with to=...") from error


def _files_below(folder: Path) -> Iterator[Path]:
    if not folder.is_dir() or folder.is_symlink():
        raise FileExistsError(f"{folder} is no folder, and is in the way: remove it, or name another place with to=...")
    return (path for path in folder.rglob("*") if not path.is_dir())


def _difference(found: bytes, wanted: bytes) -> str:
    """In what a partial folder is of another conversion."""
    try:
        before, now = json.loads(found), json.loads(wanted)
        keys = [key for key in now if before.get(key) != now[key]]
    except (ValueError, AttributeError):
        return f"is of no conversion, as it has no {DESCRIPTION} of one"
    return f"is of another conversion, which differs in {', '.join(keys)}"


def _write(folder: Path, path: str, parts: Iterable[bytes]) -> None:
    """The temporary file lies at the top of the folder, where ``_take`` finds what a killed process left."""
    target = folder / path
    temporary = folder / _TEMPORARY.replace("*", str(os.getpid()))
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with temporary.open("wb") as file:
            for part in parts:
                file.write(part)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
