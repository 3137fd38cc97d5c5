"""The speed of rendering by three clocks; ``records/latency.csv`` has a row for each."""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

from sparsestreet.records.file import CsvFile
from sparsestreet.records.run import Noise
from sparsestreet.records.strict_json import significant

RASTER, FRAME, RIG = "raster", "frame", "rig"
"""Names of the clocks. ``RASTER`` times the splat op alone. ``FRAME`` times everything from a time and a pose to a
uint8 image on the device. ``RIG`` times that for all cameras of an instant."""


@dataclass(frozen=True)
class Percentiles:
    """Percentiles of repeated times, milliseconds."""

    p50: float
    p90: float
    p99: float
    repeats: int


@dataclass(frozen=True)
class Latency:
    """Milliseconds by three clocks under the protocol of ``speed.measure_latency``."""

    clocks: dict[str, Percentiles]
    """Clock -> its times for the scene as stored; Gaussians that a mask closes are masked."""
    removed: dict[str, Percentiles]
    """The same after removing the Gaussians that the masks close at the time of the view; empty without masks."""
    warmup: int
    views: int
    """Number of different views that the repeats cycle through."""
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
        """Median of a frame, milliseconds."""
        return self.clocks[FRAME].p50

    @property
    def protocol(self) -> str:
        """Says in words how the median of a frame was taken."""
        return (
            f"{self.clocks[FRAME].repeats} renders cycling through {self.views} views after {self.warmup} warm-up "
            "renders, batch 1, device synchronized, scene assembly to uint8, without loading and metrics"
        )


@dataclass(frozen=True)
class ClockRow:
    """A clock with the kind of Gaussians that it timed."""

    clock: str
    gaussians: str
    """"all" without masks. With masks: "masked" for all Gaussians, closed ones included, or "removed" for open ones."""
    percentiles: Percentiles


def clock_rows(latency: Latency) -> Iterator[ClockRow]:
    """Yields a row for each clock."""
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
