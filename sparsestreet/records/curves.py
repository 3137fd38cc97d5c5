"""What changes over the steps of training: counts of Gaussians, a probe of held-out views, and what was logged."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from sparsestreet.records.file import CsvFile, RunFile, csv_lines, csv_text
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


def _change(cells: Sequence[str]) -> CountChange:
    step, node, before, after, reason = cells
    return CountChange(int(step), node, int(before), int(after), reason)


LEDGER = CsvFile(
    "records/counts.csv",
    tuple(field.name for field in fields(CountChange)),
    lambda change: astuple(change),  # as it stands, astuple has two types
    _change,
    "train the run",
)


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


def _cells(look: HeldOutLook) -> Sequence[object]:
    psnr = (look.psnr_full, look.psnr_human, look.psnr_vehicle)
    return f"{look.seconds:.3f}", look.step, *(None if value is None else f"{value:.4f}" for value in psnr)


def _look(cells: Sequence[str]) -> HeldOutLook:
    seconds, step, *psnr = cells
    return HeldOutLook(float(seconds), int(step), *(float(text) if text else None for text in psnr))


HELD_OUT_CURVE = CsvFile(
    "curves/held_out.csv", tuple(field.name for field in fields(HeldOutLook)), _cells, _look, "train the run"
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
