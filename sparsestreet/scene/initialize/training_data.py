"""What a node may look at when it starts: the part of a log that training sees."""

from collections.abc import Sequence
from dataclasses import dataclass

from sparsestreet.data.log import DrivingLog
from sparsestreet.types import Frame, Sweep, Track, View


@dataclass(frozen=True)
class TrainingData:
    """A log seen through its split, and which of its objects move on their own."""

    log: DrivingLog
    frames: Sequence[Frame]
    """Views to train on."""
    held_out: frozenset[int]
    """Integer frames whose sweeps and boxes must not be used."""
    tracks: tuple[Track, ...] = ()
    """The objects that were assigned to the node that asks."""
    moving: tuple[Track, ...] = ()
    """The objects of all nodes: what lies in their boxes belongs to no static node."""

    @property
    def views(self) -> Sequence[View]:
        """Cameras and times of the training views."""
        return self.frames

    @property
    def times(self) -> Sequence[float]:
        """Normalized times of the training frames, each once, in order."""
        return sorted({view.time for view in self.views})

    @property
    def sweeps(self) -> Sequence[Sweep]:
        """Lidar of the training instants, loaded one at a time."""
        return [sweep for sweep in self.log.sweeps if sweep.index not in self.held_out]
