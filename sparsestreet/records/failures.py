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
    """The column that the run would have had in a table, such as "streetgs+paper"."""
    seed: int
    command: str
    """The command of this job alone."""
    error: str
    """The error, in a sentence."""
    trace: str
    """Python's traceback."""


FAILURE = JsonFile("failed.json", FailedRun)


def read_failures(sweep: Path) -> list[tuple[Path, FailedRun]]:
    """Returns folder and failure of every failed job below a folder, sorted. Raises RecordError for a malformed one."""
    return [(run, FAILURE.read(run)) for run in FAILURE.runs(sweep)]
