"""Draws the curves of one training from its files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sparsestreet.pictures.plots import plot_counts, plot_psnr
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, LOGGED, MASK, PRUNING, CountChange
from sparsestreet.records.run import RUN

MARKED = (MASK, PRUNING)
"""Reasons of the changes that the curves mark."""

PSNR_COLUMNS = {"training, running mean": "psnr", "held out": "val/psnr"}
"""Curve -> its column in ``curves/metrics.csv``."""


_NOT_HELD_OUT = "PSNR over training (no look at held-out views: trainer.val_check_interval, split.stride)"

HELD_OUT_COLUMNS = {"full image": "psnr_full", "humans": "psnr_human", "vehicles": "psnr_vehicle"}
"""Curve -> its column in ``curves/held_out.csv``."""


def draw_history(run: Path) -> None:
    """Writes ``counts.png``, ``psnr.png`` and ``held_out.png`` to the run's folder ``curves``.

    They show ``records/counts.csv``, ``curves/metrics.csv`` and ``curves/held_out.csv``. A run without one of these
    files gets no picture of it. Raises RecordError for a malformed file.
    """
    changes = LEDGER.find(run)
    events = marks(changes or ())
    if changes is not None:
        steps, counts = _to_the_end(*count_curves(changes), run)
        plot_counts(run / "curves" / "counts.png", steps, counts, events)
    curves = psnr_curves(LOGGED.rows(run), PSNR_COLUMNS, "step")
    if curves:
        title = "PSNR over training" if "held out" in curves else _NOT_HELD_OUT
        plot_psnr(run / "curves" / "psnr.png", curves, events, title)
    curves = psnr_curves([asdict(look) for look in HELD_OUT_CURVE.find(run) or ()], HELD_OUT_COLUMNS, "seconds")
    if curves:
        title = "Held-out PSNR over training time, without evaluation"
        plot_psnr(run / "curves" / "held_out.png", curves, (), title, "seconds")


def _to_the_end(steps: list[int], counts: dict[str, list[int]], run: Path) -> tuple[list[int], dict[str, list[int]]]:
    """Returns the curves with the run's last step, at which nothing need have changed."""
    known = RUN.find(run)
    if known is None or not steps or known.steps <= steps[-1]:
        return steps, counts
    return [*steps, known.steps], {name: [*series, series[-1]] for name, series in counts.items()}


def count_curves(changes: Sequence[CountChange]) -> tuple[list[int], dict[str, list[int]]]:
    """Returns the steps at which any node changes, and node -> its number of Gaussians after each of these steps.

    >>> count_curves([CountChange(0, "road", 0, 9, "start"), CountChange(5, "cars", 0, 4, "start")])
    ([0, 5], {'road': [9, 9], 'cars': [0, 4]})
    """
    steps = sorted({change.step for change in changes})
    curves: dict[str, list[int]] = {change.node: [] for change in changes}
    for node, series in curves.items():
        # The ledger is in order, so the last of several changes in one step counts.
        after = {change.step: change.after for change in changes if change.node == node}
        gaussians = 0
        for step in steps:
            gaussians = after.get(step, gaussians)
            series.append(gaussians)
    return steps, curves


def marks(changes: Sequence[CountChange]) -> list[tuple[int, str]]:
    """Returns (step, reason) of the changes that make the scene small, each once, in order.

    >>> marks([CountChange(0, "road", 0, 9, "start"), CountChange(8, "road", 9, 6, PRUNING)])
    [(8, 'pruning')]
    """
    return list(dict.fromkeys((change.step, change.reason) for change in changes if change.reason in MARKED))


def psnr_curves(
    rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str], along: str
) -> dict[str, tuple[Sequence[int | float], Sequence[float]]]:
    """Returns name of a curve -> (steps or seconds, dB), from the rows that have a value.

    >>> psnr_curves([{"step": 1.0, "psnr": 20.5}, {"step": 2.0, "psnr": None}], {"training": "psnr"}, "step")
    {'training': ((1.0,), (20.5,))}
    """
    curves = {}
    for label, column in columns.items():
        points = [(float(row[along]), float(row[column])) for row in rows if row.get(column) not in (None, "")]
        if points:
            curves[label] = tuple(zip(*points, strict=True))
    return curves
