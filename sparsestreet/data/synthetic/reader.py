"""The built-in default log: a street that is made when it is first needed, and read like any other log."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.frame_cache import CacheSize
from sparsestreet.data.log import DrivingLog, SceneExtent
from sparsestreet.data.problems import Problem
from sparsestreet.data.reader import LogReader
from sparsestreet.data.synthetic.declared import with_declared
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import make_street, street_name
from sparsestreet.data.synthetic.truth import street_truth

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreetReader(LogReader):
    """Makes the street in its folder unless it is there, and reads it like a recorded drive.

    ``check`` and ``read`` raise FileExistsError if the folder holds anything else.
    """

    settings: StreetSettings
    root: Path | str | None = None
    """The street's folder; None: a folder under ``parent`` that is named after all settings."""
    parent: Path | str = "outputs/streets"
    lidar: bool = True
    """False: the log has no lidar, although the street is traced with it."""
    bodies: bool = True
    """False: the log has no body poses of the street's pedestrians."""
    undistort: bool = False
    lidar_ahead: Sequence[float | int] | None = None
    extent: SceneExtent = "world"
    """This and the two above as ``DriveStudioReader`` has them."""
    cache_mb: CacheSize = "auto"
    """Decoded frames kept in memory, MB (1e6 bytes)."""

    @property
    def folder(self) -> Path:
        return Path(self.parent) / street_name(self.settings) if self.root is None else Path(self.root)

    def check(self) -> list[Problem]:
        return self._made().check()

    def read(self) -> DrivingLog:
        log = with_declared(self._made().read(), self.settings, self.folder)
        return replace(log, truth=street_truth(self.settings, log.dataset_from_world))

    def data_hash(self) -> str:
        """Returns the street's name, which holds a hash of all settings: they determine what the street shows."""
        return street_name(self.settings)

    def _made(self) -> DriveStudioReader:
        root = make_street(self.settings, self.folder, self._report)
        return DriveStudioReader(
            root,
            lidar=self.lidar,
            bodies=self.bodies,
            undistort=self.undistort,
            lidar_ahead=self.lidar_ahead,
            extent=self.extent,
            cache_mb=self.cache_mb,
        )

    def _report(self, done: int, total: int) -> None:
        """Reports each time another quarter of the frames is traced."""
        if done * 4 // total > (done - 1) * 4 // total:
            log.info("tracing a street into %s: %d of %d frames", self.folder.absolute(), done, total)
