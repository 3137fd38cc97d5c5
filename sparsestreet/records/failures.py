"""``RUN/failed.json``: why a job of a sweep has no record."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import version


@dataclass(frozen=True, kw_only=True)
class FailedRun:
    """A job that ended with an error."""

    format: int = version(1, "run the sweep again")
    label: str
    """What would be the run's column, such as "streetgs+paper"."""
    seed: int
    command: str
    """The command of this job alone."""
    error: str
    """What it died of, in a sentence."""
    trace: str
    """Where: Python's trace."""


FAILURE = JsonFile("failed.json", FailedRun)


def read_failures(sweep: Path) -> list[tuple[Path, FailedRun]]:
    """Folder and reason of every job that failed below a folder, sorted. Raises RecordError for a malformed one."""
    return [(run, FAILURE.read(run)) for run in FAILURE.runs(sweep)]
