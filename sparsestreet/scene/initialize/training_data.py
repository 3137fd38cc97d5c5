"""The part of a log that training sees, from which nodes start."""

from collections.abc import Sequence
from dataclasses import dataclass

from sparsestreet.data.lazy import Frames, Sweeps
from sparsestreet.data.log import DrivingLog
from sparsestreet.triangulation import StreetPoints
from sparsestreet.types import Track, View


@dataclass(frozen=True)
class TrainingData:
    """The training part of a log, and the objects that nodes move."""

    log: DrivingLog
    frames: Frames
    """Views to train on; pixels are read when a view is indexed."""
    held_out: frozenset[int]
    """Integer frames whose sweeps and boxes must not be used."""
    tracks: tuple[Track, ...] = ()
    """The objects that were assigned to the node that is built."""
    moving: tuple[Track, ...] = ()
    """The objects of all nodes; points in their boxes belong to no static node."""
    image_points: StreetPoints | None = None
    """Points triangulated from ``frames``; None if the run makes none."""

    @property
    def views(self) -> Sequence[View]:
        """Cameras and times of the training views, without pixels."""
        return self.frames.views

    @property
    def times(self) -> Sequence[float]:
        """Normalized times of the training frames, in order: of each the time of its first view."""
        first: dict[int, float] = {}
        for view in self.views:
            index, _ = view.indices
            first[index] = min(view.time, first.get(index, view.time))
        return sorted(first.values())

    @property
    def sweeps(self) -> Sweeps:
        """Lidar of the training instants; a sweep is read when it is indexed."""
        return self.log.sweeps.where(lambda index: index not in self.held_out)
