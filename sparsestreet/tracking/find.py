"""Find what moves in a drive, in its lidar alone."""

from collections.abc import Callable, Sequence

from sparsestreet.tracking.objects import FoundObject
from sparsestreet.tracking.scans import Scan
from sparsestreet.tracking.settings import TrackingSettings


def find_objects(
    scans: Sequence[Scan], settings: TrackingSettings, report: Callable[[int, int], None]
) -> tuple[FoundObject, ...]:
    raise NotImplementedError
