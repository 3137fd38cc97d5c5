"""Finds the records of finished runs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.summary import SUMMARY, RunSummary


@dataclass(frozen=True)
class RunRecord:
    """A run's folder and its summary."""

    folder: Path
    summary: RunSummary


def collect(roots: Iterable[Path]) -> list[RunRecord]:
    """Returns every run below the given folders once, sorted by path.

    Raises FileNotFoundError for a root without records, RecordError (naming the file) for a malformed one.
    """
    folders: set[Path] = set()
    for root in roots:
        found = SUMMARY.runs(root)
        if not found:
            raise FileNotFoundError(f"{root} holds no {SUMMARY.name}: train and evaluate a run there first")
        folders |= {folder.resolve() for folder in found}
    return [RunRecord(folder, SUMMARY.read(folder)) for folder in sorted(folders)]


def check_definitions(records: Sequence[RunRecord]) -> None:
    """Raises ValueError if two records define one metric differently."""
    seen: dict[str, tuple[str, Path]] = {}
    for record in records:
        for name, definition in record.summary.definitions.items():
            known, folder = seen.setdefault(name, (definition, record.folder))
            if known != definition:
                raise ValueError(f"{name} means different things in {folder} and {record.folder}: evaluate one again")
