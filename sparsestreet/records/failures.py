"""``RUN/failed.json``: why a job of a sweep has no record (no torch)."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.strict_json import read_json, version, write_json


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


def failure_path(run: Path) -> Path:
    """Where a job says that it failed."""
    return run / "failed.json"


def write_failure(run: Path, failure: FailedRun) -> None:
    """Write ``failed.json`` atomically, creating the folder."""
    write_json(failure_path(run), failure)


def read_failures(sweep: Path) -> list[tuple[Path, FailedRun]]:
    """Folder and reason of every job that failed below a folder, sorted. Raises RecordError for a malformed one."""
    return [(path.parent, read_json(path, FailedRun)) for path in sorted(sweep.rglob("failed.json"))]
