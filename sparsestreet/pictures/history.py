"""Curves of one training, drawn from the files it left."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from sparsestreet.pictures.plots import plot_counts, plot_psnr
from sparsestreet.records.held_out import HELD_OUT_CURVE
from sparsestreet.records.ledger import LEDGER, MASK, PRUNING, CountChange
from sparsestreet.records.logged import LOGGED

MARKED = (MASK, PRUNING)
"""Reasons of changes that the curves mark."""

PSNR_COLUMNS = {"training, running mean": "psnr", "held out": "val/psnr"}
"""Curve -> its column in ``curves/metrics.csv``."""


HELD_OUT_COLUMNS = {"full image": "psnr_full", "humans": "psnr_human", "vehicles": "psnr_vehicle"}
"""Curve -> its column in ``curves/held_out.csv``."""


def draw_history(run: Path) -> None:
    """Write ``counts.png``, ``psnr.png`` and ``held_out.png`` in ``curves``, from ``records/counts.csv`` and, beside
    them, ``metrics.csv`` and ``held_out.csv``.

    A file that the run was configured not to write leaves its picture out. Raises RecordError for a malformed one.
    """
    changes = LEDGER.find(run)
    events = marks(changes or ())
    if changes is not None:
        steps, counts = count_curves(changes)
        plot_counts(run / "curves" / "counts.png", steps, counts, events)
    curves = psnr_curves(LOGGED.rows(run), PSNR_COLUMNS, "step")
    if curves:
        plot_psnr(run / "curves" / "psnr.png", curves, events)
    curves = psnr_curves([asdict(look) for look in HELD_OUT_CURVE.find(run) or ()], HELD_OUT_COLUMNS, "seconds")
    if curves:
        title = "Held-out PSNR over training time, without evaluation"
        plot_psnr(run / "curves" / "held_out.png", curves, (), title, "seconds")


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


def psnr_curves(
    rows: Sequence[Mapping[str, str | float | None]], columns: Mapping[str, str], along: str
) -> dict[str, tuple[Sequence[int | float], Sequence[float]]]:
    """Name of a curve -> (steps or seconds, dB), from the rows that hold it."""
    curves = {}
    for label, column in columns.items():
        points = [(float(row[along]), float(row[column])) for row in rows if row.get(column) not in (None, "")]
        if points:
            curves[label] = tuple(zip(*points, strict=True))
    return curves
