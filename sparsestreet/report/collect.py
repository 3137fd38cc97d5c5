"""Finds the records of finished runs, and writes what of them a repository can keep."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.strict_json import json_line, write_atomically
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
        if not root.is_dir():
            raise FileNotFoundError(f"{root} {'is a file' if root.exists() else 'is not there'}: name a folder of runs")
        found = SUMMARY.runs(root)
        if not found:
            raise FileNotFoundError(f"{root} holds no {SUMMARY.name}: train and evaluate a run there first")
        folders |= {folder.resolve() for folder in found}
    return [RunRecord(folder, SUMMARY.read(folder)) for folder in sorted(folders)]


def keep_records(records: Sequence[RunRecord], path: Path) -> None:
    """Write a line of JSON for each run, some kilobytes, so that a page's numbers can be checked without its scenes.

    A line has what identifies the run (label, log, seed, hashes, command without folders, commit, machine). It has the
    means of each split in the metrics' units, Gaussians and bytes by part, milliseconds of a frame and seconds of
    training.

    Raises OSError where the file cannot be written.
    """
    lines = [json_line(_kept(record.summary), str(record.folder)) for record in records]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, "".join(f"{line}\n" for line in lines))


def _kept(summary: RunSummary) -> dict[str, object]:
    run = summary.run
    means = {
        split: {name: one.mean for name, one in metrics.items() if one.mean is not None}
        for split, metrics in summary.quality.items()
    }
    return {
        **{name: getattr(run, name) for name in ("label", "method", "sparsify", "scene", "seed", "split", "steps")},
        "config_hash": run.config_hash,
        "data_hash": run.data_hash,
        # A repository is no place for the folders of a machine.
        "command": re.sub(r"(?<![^=\s,\[])(?:~|\.{0,2})/[^\s,\]]*/", "", run.command),
        "source": run.source,
        "machine": {**vars(run.machine), "device": run.device, "threads": run.threads},
        "sizes": summary.resolutions,
        "images": summary.images,
        "quality": means,
        "gaussians": summary.gaussians,
        "gaussians_total": summary.gaussians_total,
        "caps": run.caps,
        "bytes": summary.bytes_by_part,
        "bytes_total": summary.bytes_total,
        "frame_ms": summary.latency.p50,
        "quiet": summary.latency.noise.quiet and (run.noise is None or run.noise.quiet),
        "training_seconds": run.training_seconds,
    }


def check_definitions(records: Sequence[RunRecord]) -> None:
    """Raises ValueError if two records define one metric differently."""
    seen: dict[str, tuple[str, Path]] = {}
    for record in records:
        for name, definition in record.summary.definitions.items():
            known, folder = seen.setdefault(name, (definition, record.folder))
            if known != definition:
                raise ValueError(f"{name} means different things in {folder} and {record.folder}: evaluate one again")
