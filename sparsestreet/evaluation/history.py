"""Curves of one training, drawn from the files it left (no torch)."""

import csv
from collections.abc import Sequence
from pathlib import Path

from sparsestreet.evaluation.ledger import MASK, PRUNING, CountChange, ledger_path, read_changes
from sparsestreet.evaluation.plots import plot_counts, plot_psnr

MARKED = (MASK, PRUNING)
"""Reasons of changes that the curves mark."""

PSNR_COLUMNS = {"training, running mean": "psnr", "held out": "val/psnr"}
"""Curve -> its column in ``curves/metrics.csv``."""


def draw_history(run: Path) -> None:
    """Write ``curves/counts.png`` and ``curves/psnr.png`` from ``records/counts.csv`` and ``curves/metrics.csv``.

    A file that the run was configured not to write leaves its picture out. Raises RecordError for a malformed ledger.
    """
    ledger, metrics = ledger_path(run), run / "curves" / "metrics.csv"
    events: list[tuple[int, str]] = []
    if ledger.is_file():
        changes = read_changes(ledger)
        events = marks(changes)
        steps, counts = count_curves(changes)
        plot_counts(run / "curves" / "counts.png", steps, counts, events)
    curves = psnr_curves(metrics) if metrics.is_file() else {}
    if curves:
        plot_psnr(run / "curves" / "psnr.png", curves, events)


def count_curves(changes: Sequence[CountChange]) -> tuple[list[int], dict[str, list[int]]]:
    """The steps at which any node changes, and node -> its Gaussians after each; constant between its own changes."""
    steps = sorted({change.step for change in changes})
    curves: dict[str, list[int]] = {change.node: [] for change in changes}
    for node, series in curves.items():
        # Of several changes in one step the last one counts: the ledger is in order.
        after = {change.step: change.after for change in changes if change.node == node}
        gaussians = 0
        for step in steps:
            gaussians = after.get(step, gaussians)
            series.append(gaussians)
    return steps, curves


def marks(changes: Sequence[CountChange]) -> list[tuple[int, str]]:
    """(step, reason) of the changes that make the scene small, each once, in order."""
    return list(dict.fromkeys((change.step, change.reason) for change in changes if change.reason in MARKED))


def psnr_curves(path: Path) -> dict[str, tuple[Sequence[int], Sequence[float]]]:
    """Name of a curve -> (steps, dB), from the rows of Lightning's ``metrics.csv`` that hold it."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    curves = {}
    for label, column in PSNR_COLUMNS.items():
        points = [(int(row["step"]), float(row[column])) for row in rows if row.get(column)]
        if points:
            curves[label] = tuple(zip(*points, strict=True))
    return curves
