"""The record of ``sparsestreet bench step``."""

from dataclasses import dataclass

from sparsestreet.bench.floors import Floor
from sparsestreet.bench.timing import TimeSpread


@dataclass(frozen=True)
class PhaseRecord:
    """One phase; a floor of None is not known, or next to nothing."""

    name: str
    time: TimeSpread
    operations: float
    """Dispatched tensor operations a step; views are not counted."""
    floor: Floor | None
    floor_ms: float | None


@dataclass(frozen=True)
class StepRecord:
    """A step of training, from one batch's end to the next one's; times are milliseconds."""

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
        """The step over its op."""
        return self.step.median / self.op.median
