"""``records/latency.csv``: the percentiles of every clock, one row each (no torch)."""

import csv
import io
from dataclasses import astuple
from pathlib import Path

from sparsestreet.records.strict_json import significant, write_atomically
from sparsestreet.records.summary import Latency

_COLUMNS = ("clock", "rows", "p50", "p90", "p99", "repeats")


def latency_path(run: Path) -> Path:
    """Where a run keeps its latencies."""
    return run / "records" / "latency.csv"


def write_latency(path: Path, latency: Latency) -> None:
    """Write a row for each clock atomically: of "all" Gaussians, or, where the scene has masks, of all with those that
    are closed "masked" and of the others with them "removed"; milliseconds."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for rows, clocks in (("masked" if latency.removed else "all", latency.clocks), ("removed", latency.removed)):
        for clock, times in clocks.items():
            *percentiles, repeats = astuple(times)
            writer.writerow((clock, rows, *(significant(value, f"{path}: {clock}") for value in percentiles), repeats))
    write_atomically(path, buffer.getvalue())
