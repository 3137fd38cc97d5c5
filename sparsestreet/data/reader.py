"""What every data set offers: to be checked, and to be read."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

from sparsestreet.data.lazy import Frames
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

    def shifted(self, log: DrivingLog) -> Mapping[float, Frames]:
        """Images beside the recorded path, where there are any: meters to the right of the rig -> front views at the
        instants of the log that was read. Recorded drives have none."""
        return {}
