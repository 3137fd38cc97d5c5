"""The curves of a run that was stopped and went on stay whole."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sparsestreet.records.logged import LOGGED


@contextmanager
def kept_curves(run: Path, resumed_at: int | None) -> Iterator[None]:
    """While training goes on, keep what ``metrics.csv`` said of the steps before ``resumed_at``; None: a new run.

    Lightning's CSV logger begins its file anew. What an earlier part logged behind the checkpoint is left out: those
    steps are taken again.
    """
    earlier = [] if resumed_at is None else [row for row in LOGGED.rows(run) if int(row["step"]) < resumed_at]
    try:
        yield
    finally:
        if earlier:
            LOGGED.write(run, earlier + LOGGED.rows(run))
