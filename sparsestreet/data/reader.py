"""What every data set offers: to be checked, and to be read."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from sparsestreet.data.fingerprint import LogFiles, hash_files
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.marks import Marks
from sparsestreet.data.problems import Problem


class LogReader(ABC):
    """A log on disk and the part of it that is wanted; both verbs look at that part only."""

    marks: ClassVar[Marks | None] = None
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

    def data_hash(self) -> str:
        """12 hexadecimal digits that are equal for the same log, wherever it lies (``fingerprint.hash_files``)."""
        return hash_files(self.folder, self.files())
