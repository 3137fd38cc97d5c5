"""The record of ``sparsestreet bench step``."""

from dataclasses import dataclass

from sparsestreet.bench.floors import Floor
from sparsestreet.bench.timing import TimeSpread


@dataclass(frozen=True)
class PhaseRecord:
    """One phase; a floor of None is unknown or negligible."""

    name: str
    time: TimeSpread
    operations: float
    """Dispatched tensor operations per step, without views."""
    floor: Floor | None
    floor_ms: float | None


@dataclass(frozen=True)
class StepRecord:
    """A training step, from the end of one batch to the end of the next; times are milliseconds."""

    what: str
    gaussians: dict[str, int]
    width: int
    height: int
    step: TimeSpread
    op: TimeSpread
    """The splat op, forward and backward."""
    operations: float
    bandwidth_gb_s: float
    peak_gflops: float
    phases: tuple[PhaseRecord, ...]

    @property
    def ratio(self) -> float:
        """Time of the step divided by that of its op."""
        return self.step.median / self.op.median
