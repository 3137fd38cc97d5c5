"""Finds the records of finished runs."""

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.same_as import SAME_AS
from sparsestreet.records.summary import SUMMARY, RunSummary


@dataclass(frozen=True)
class RunRecord:
    """A run's folder and its summary."""

    folder: Path
    summary: RunSummary


def collect(roots: Iterable[Path]) -> list[RunRecord]:
    """Returns every run below the given folders once, sorted by path.

    A run that a second sweep took from a first one counts as that of the first, where both are below the folders and
    call it the same: it is no repeat.

    Raises FileNotFoundError for a root without records, RecordError (naming the file) for a malformed one.
    """
    folders: set[Path] = set()
    for root in roots:
        if not root.is_dir():
            raise FileNotFoundError(f"{root} {'is a file' if root.exists() else 'is not there'}: name a folder of runs")
        found = SUMMARY.runs(root)
        if not found:
            raise FileNotFoundError(f"{root} holds no {SUMMARY.name}: train and evaluate a run there first")
        folders |= {folder.resolve() for folder in found}
    records = [RunRecord(folder, SUMMARY.read(folder)) for folder in sorted(folders)]
    return [record for record in records if not _stands_for_another(record, folders)]


def _stands_for_another(record: RunRecord, folders: Set[Path]) -> bool:
    same = SAME_AS.find(record.folder)
    if same is None or same.label != record.summary.run.label:
        return False
    return (record.folder / same.run).resolve() in folders


def check_definitions(records: Sequence[RunRecord]) -> None:
    """Raises ValueError if two records define one metric differently."""
    seen: dict[str, tuple[str, Path]] = {}
    for record in records:
        for name, definition in record.summary.definitions.items():
            known, folder = seen.setdefault(name, (definition, record.folder))
            if known != definition:
                raise ValueError(f"{name} means different things in {folder} and {record.folder}: evaluate one again")
