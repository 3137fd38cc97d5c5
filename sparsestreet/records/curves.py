"""What changes over the steps of training: counts of Gaussians, a probe of held-out views, and what was logged."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.records.file import RunFile, csv_lines, csv_text, table_of
from sparsestreet.records.strict_json import write_atomically

MASK, PRUNING = "mask", "pruning"
"""Reasons of the changes that make a scene small: a mask closed Gaussians, or a pruning rule selected them."""


@dataclass(frozen=True)
class CountChange:
    """A line of the ledger."""

    step: int
    node: str
    before: int
    after: int
    reason: str
    """A word or two: "start", "densify", "cull", ``MASK``, ``PRUNING`` ..."""


LEDGER = table_of("records/counts.csv", CountChange, "train the run")


@dataclass(frozen=True)
class HeldOutLook:
    """One evaluation of the probe."""

    seconds: float
    """Seconds of training alone, summed over all commands of an interrupted run."""
    step: int
    psnr_full: float | None
    """dB, all pixels."""
    psnr_human: float | None
    """dB; None where no view has the mask."""
    psnr_vehicle: float | None
    """dB; None where no view has the mask."""


HELD_OUT_CURVE = table_of(
    "curves/held_out.csv",
    HeldOutLook,
    "train the run",
    seconds=".3f",
    **dict.fromkeys(("psnr_full", "psnr_human", "psnr_vehicle"), ".4f"),
)


Logged = dict[str, str]
"""Column -> text; blank where a row has no value."""


@dataclass(frozen=True)
class LoggedFile(RunFile):
    """Rows whose columns are whatever training logs."""

    def rows(self, run: Path) -> list[Logged]:
        """Return all rows; none for a run without the file. What a kill left of a line is none.

        Raises RecordError for what is no text.
        """
        if not self.exists(run):
            return []
        head, *lines = csv_lines(self.path(run), "remove it, or train the run") or [[]]
        rows = [dict(zip(head, line, strict=True)) for line in lines if len(line) == len(head)]
        return [row for row in rows if row.get("step", "").isdecimal()]

    def write(self, run: Path, rows: Sequence[Logged]) -> None:
        """Write the whole file or nothing, with every column that any row has, in order of appearance."""
        columns = list(dict.fromkeys(name for row in rows for name in row))
        write_atomically(self.path(run), csv_text(columns, [[row.get(name) for name in columns] for row in rows]))


LOGGED = LoggedFile("curves/metrics.csv")
