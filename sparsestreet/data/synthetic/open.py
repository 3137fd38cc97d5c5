"""The embedded default: a street that is made when it is first asked for, and read like any other log."""

import logging
from pathlib import Path

from sparsestreet.data.drivestudio import read_drivestudio
from sparsestreet.data.log import DrivingLog
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.street import make_street

log = logging.getLogger(__name__)


def open_street(settings: StreetSettings, root: str | Path) -> DrivingLog:
    """Make the street at ``root`` unless it is there, and read it through the reader of recorded drives.

    Raises FileExistsError where ``root`` holds anything else.
    """
    return read_drivestudio(make_street(settings, Path(root), progress=_report))


def _report(done: int, total: int) -> None:
    """A line when a quarter more is traced."""
    if done * 4 // total > (done - 1) * 4 // total:
        log.info("tracing the street: %d of %d frames", done, total)
