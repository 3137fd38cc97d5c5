"""The embedded default: a street that is made when it is first asked for, and read like any other log."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from sparsestreet.data.drivestudio import DriveStudioReader
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.problems import Problem
from sparsestreet.data.reader import LogReader
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import make_street, street_name
from sparsestreet.data.synthetic.truth import street_truth

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreetReader(LogReader):
    """Makes the street in its folder, unless it is there, and reads it as a recorded drive is read.

    Both verbs raise FileExistsError where the folder holds anything else.
    """

    settings: StreetSettings
    root: Path | str | None = None
    """The street's folder; None: one under ``parent`` that is named after the settings, all of them."""
    parent: Path | str = "outputs/streets"
    lidar: bool = True
    """False: as if the street had none, though it is traced with its own."""
    bodies: bool = True
    """False: as if the street had no body poses of its pedestrians."""
    min_lens_shift: float | None = 0.5
    """Pixels; the settings' lens is simulated where it moves some pixel by at least so much; 0: always, None: never."""
    cache_mb: int = 512
    """Decoded frames kept in memory, MB (1e6 bytes)."""

    @property
    def folder(self) -> Path:
        return Path(self.parent) / street_name(self.settings) if self.root is None else Path(self.root)

    def check(self) -> list[Problem]:
        return self._made().check()

    def read(self) -> DrivingLog:
        log = self._made().read()
        return replace(log, truth=street_truth(self.settings, log.dataset_from_world))

    def data_hash(self) -> str:
        """The street's name, which holds a hash of all of its settings: what they say is what it shows."""
        return street_name(self.settings)

    def _made(self) -> DriveStudioReader:
        root = make_street(self.settings, self.folder, self._report)
        return DriveStudioReader(
            root, lidar=self.lidar, bodies=self.bodies, min_lens_shift=self.min_lens_shift, cache_mb=self.cache_mb
        )

    def _report(self, done: int, total: int) -> None:
        """A line when a quarter more is traced."""
        if done * 4 // total > (done - 1) * 4 // total:
            log.info("tracing a street into %s: %d of %d frames", self.folder.absolute(), done, total)
