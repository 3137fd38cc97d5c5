"""How fast a scene is drawn, by three clocks; ``records/latency.csv`` has a row for each."""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

from sparsestreet.records.file import CsvFile
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import significant

RASTER, FRAME, RIG = "raster", "frame", "rig"
"""What the clocks of a latency hold: the splat op alone; all from a time and a pose to uint8 on the device; that for
all cameras of an instant."""


@dataclass(frozen=True)
class Percentiles:
    """Of repeated times, milliseconds."""

    p50: float
    p90: float
    p99: float
    repeats: int


@dataclass(frozen=True)
class Latency:
    """Milliseconds by three clocks under the protocol of ``speed.measure_latency``."""

    clocks: dict[str, Percentiles]
    """``RASTER``, ``FRAME`` and ``RIG`` of the scene as it is stored; Gaussians that a mask closes are masked."""
    removed: dict[str, Percentiles]
    """The same with the Gaussians taken out that the masks close at the time of the view; empty without masks."""
    warmup: int
    views: int
    """Number of different views the repeats cycle through."""
    device: str
    threads: int
    noise: Noise

    def __post_init__(self) -> None:
        if set(self.clocks) != {RASTER, FRAME, RIG} or set(self.removed) not in (set(), set(self.clocks)):
            raise ValueError(
                f"a latency has the clocks {RASTER}, {FRAME}, {RIG}, got {sorted(self.clocks)} and, of removed "
                f"Gaussians, {sorted(self.removed)}: evaluate again"
            )

    @property
    def p50(self) -> float:
        """Median of a frame."""
        return self.clocks[FRAME].p50

    @property
    def protocol(self) -> str:
        """How the median of a frame was taken, in words."""
        return (
            f"{self.clocks[FRAME].repeats} renders cycling through {self.views} views after {self.warmup} warm-up "
            "renders, batch 1, device synchronized, scene assembly to uint8, without loading and metrics"
        )


@dataclass(frozen=True)
class ClockRow:
    """A clock, with the Gaussians that it took."""

    clock: str
    gaussians: str
    """"all", or where the scene has masks: "masked", all with those that are closed, or "removed", the others."""
    percentiles: Percentiles


def clock_rows(latency: Latency) -> Iterator[ClockRow]:
    """A row for each clock."""
    for gaussians, clocks in (("masked" if latency.removed else "all", latency.clocks), ("removed", latency.removed)):
        for clock, percentiles in clocks.items():
            yield ClockRow(clock, gaussians, percentiles)


def _cells(row: ClockRow) -> Sequence[object]:
    *times, repeats = astuple(row.percentiles)
    return row.clock, row.gaussians, *(significant(value, row.clock) for value in times), repeats


def _row(cells: Sequence[str]) -> ClockRow:
    clock, gaussians, p50, p90, p99, repeats = cells
    return ClockRow(clock, gaussians, Percentiles(float(p50), float(p90), float(p99), int(repeats)))


LATENCY = CsvFile(
    "records/latency.csv", ("clock", "rows", "p50", "p90", "p99", "repeats"), _cells, _row, "evaluate the run"
)
