"""``curves/held_out.csv``: the quality of a fixed probe of held-out views over the seconds of training."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

from sparsestreet.records.file import CsvFile


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
