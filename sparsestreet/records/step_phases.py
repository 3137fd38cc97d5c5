"""``records/phases.csv``: the duration of the parts of some training steps."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

from sparsestreet.records.file import CsvFile


@dataclass(frozen=True)
class StepPhase:
    """A part of a step that was timed."""

    step: int
    phase: str
    milliseconds: float


def _cells(part: StepPhase) -> Sequence[object]:
    return part.step, part.phase, f"{part.milliseconds:.4f}"


def _part(cells: Sequence[str]) -> StepPhase:
    step, phase, milliseconds = cells
    return StepPhase(int(step), phase, float(milliseconds))


STEP_PHASES = CsvFile(
    "records/phases.csv", tuple(field.name for field in fields(StepPhase)), _cells, _part, "train the run"
)
