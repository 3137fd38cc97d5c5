"""What every layout offers that a log can be written in: its files, and what it has no room for."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from sparsestreet.data.log import DrivingLog


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
