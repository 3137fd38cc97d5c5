"""What every data set offers: to be checked, and to be read."""

import hashlib
from abc import ABC, abstractmethod
from pathlib import Path

from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import Problem


class LogReader(ABC):
    """A log on disk and the part of it that is wanted; both verbs look at that part only."""

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

    def data_hash(self) -> str:
        """12 hexadecimal digits of the SHA-256 over all files below ``folder``, in order of their names: name, size,
        first and last 64 kB of each. Equal for the same log in another place; the wanted part does not count."""
        digest = hashlib.sha256()
        for path in sorted(self.folder.rglob("*")):
            if path.is_file():
                digest.update(f"{path.relative_to(self.folder).as_posix()} {path.stat().st_size}\n".encode())
                digest.update(_ends(path))
        return digest.hexdigest()[:12]


_END = 65536


def _ends(path: Path) -> bytes:
    """The first and the last 64 kB of a file, all of it where it has no more than both."""
    with path.open("rb") as file:
        first = file.read(_END)
        file.seek(max(_END, path.stat().st_size - _END))
        return first + file.read()
