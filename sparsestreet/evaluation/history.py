"""Curves of one training, drawn from the files it left (no torch)."""

import csv
from pathlib import Path

from sparsestreet.evaluation.plots import plot_counts, plot_psnr

STAGES = ("mask", "background pruning")
"""Reasons in the ledger of row changes that are worth a mark."""


def draw_history(run: Path) -> None:
    """Write ``curves/counts.png`` and ``curves/psnr.png`` from ``records/counts.csv`` and ``curves/metrics.csv``.

    A file that the run was configured not to write leaves its picture out.
    """
    ledger, metrics = run / "records" / "counts.csv", run / "curves" / "metrics.csv"
    if ledger.is_file():
        _draw_counts(_rows(ledger), run / "curves" / "counts.png")
    if metrics.is_file():
        _draw_psnr(_rows(metrics), run / "curves" / "psnr.png")


def _draw_counts(changes: list[dict[str, str]], path: Path) -> None:
    """Counts are constant between two changes of their node."""
    steps = sorted({int(change["step"]) for change in changes})
    counts: dict[str, list[int]] = {change["node"]: [] for change in changes}
    for node, series in counts.items():
        after = {int(change["step"]): int(change["after"]) for change in changes if change["node"] == node}
        rows = 0
        for step in steps:
            rows = after.get(step, rows)
            series.append(rows)
    events = [(int(change["step"]), change["reason"]) for change in changes if change["reason"] in STAGES]
    plot_counts(path, steps, counts, events)


def _draw_psnr(rows: list[dict[str, str]], path: Path) -> None:
    curves = {}
    for label, column in (("training, running mean", "psnr"), ("held out", "val/psnr")):
        points = [(int(row["step"]), float(row[column])) for row in rows if row.get(column)]
        if points:
            curves[label] = tuple(zip(*points, strict=True))
    if curves:
        plot_psnr(path, curves)


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
