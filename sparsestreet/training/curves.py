"""The curves of a run that was stopped and went on stay whole."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sparsestreet.records.curves import LOGGED, Logged, LoggedFile

EARLIER = LoggedFile("curves/earlier.csv")
"""What a run logged before it went on, while it goes on: another kill must not lose it."""


@contextmanager
def kept_curves(run: Path, resumed_at: int | None, of: Path | None = None) -> Iterator[None]:
    """While training goes on, keep what ``metrics.csv`` said of the steps before ``resumed_at``; None: a new run.

    ``of``: the run whose checkpoint it goes on from; None: this one.

    Lightning's CSV logger begins its file anew. What an earlier part logged behind the checkpoint is left out: those
    steps are taken again.
    """
    logged = [] if resumed_at is None else _joined(of or run)
    earlier = [row for row in logged if resumed_at is not None and int(row["step"]) < resumed_at]
    if earlier:
        EARLIER.write(run, earlier)
    try:
        yield
    finally:
        if earlier:
            LOGGED.write(run, _joined(run))
            EARLIER.remove(run)


def _joined(run: Path) -> list[Logged]:
    """The rows of both files; a kill may leave a row in both."""
    rows = [*EARLIER.rows(run), *LOGGED.rows(run)]
    return list({tuple(sorted((name, text) for name, text in row.items() if text)): row for row in rows}.values())
