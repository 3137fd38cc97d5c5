"""Whether a run that was made again gave what its record says, within the noise of such runs."""

import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from sparsestreet.metrics.definitions import Protocol
from sparsestreet.naming import one_line
from sparsestreet.records.summary import RunSummary
from sparsestreet.report.collect import clip_of

TWO_RUNS = 2 * math.sqrt(2)
"""Standard deviations by which two runs differ at most, 19 times of 20."""
MIN_REPEATS = 2
"""Repeats from which on a standard deviation is known."""


@dataclass(frozen=True)
class _Quantity:
    name: str
    text: str
    noise: float
    """By which a run of one seed differs on another processor (docs/results/protocol.md)."""
    relative: bool = False
    """Whether that is a part of the value."""


_PSNR = _Quantity("PSNR", "{:.3f} dB", 0.05)
_VEHICLES = _Quantity("vehicles", "{:.3f} dB", 0.2)
_PEOPLE = _Quantity("people", "{:.3f} dB", 0.2)
_SSIM = _Quantity("SSIM", "{:.4f}", 0.002)
_GAUSSIANS = _Quantity("Gaussians", "{:,.0f}", 0.02, relative=True)
_MB = _Quantity("MB", "{:.3f}", 0.02, relative=True)


@dataclass(frozen=True)
class Comparison:
    """One number of a record beside that of the run that was made again."""

    quantity: _Quantity
    recorded: float | None
    found: float | None
    noise: float
    repeats: int
    """Runs of other seeds that the noise comes from; 0: it is the stated one."""

    @property
    def holds(self) -> bool:
        """Whether both are there, or none, and differ by no more than the noise."""
        if self.recorded is None or self.found is None:
            return self.recorded is self.found
        return abs(self.found - self.recorded) <= self.noise

    def __str__(self) -> str:
        form = self.quantity.text.format
        recorded, found = ("none" if value is None else form(value) for value in (self.recorded, self.found))
        said = f"{self.quantity.name} {found}"
        if self.found == self.recorded:
            return f"{said}, as recorded"
        source = f" by {self.repeats} other seeds" if self.repeats else ""
        fails = "" if self.holds else ": DOES NOT HOLD"
        return f"{said}, recorded {recorded} (± {form(self.noise)}{source}){fails}"


def comparisons(
    recorded: RunSummary, found: RunSummary, others: Iterable[RunSummary], protocol: Protocol
) -> list[Comparison]:
    """Compare quality of the main split, Gaussians and bytes; times are another machine's.

    The noise is the stated one, or that of two runs by the spread of ``repeats_of`` where it is larger. The run itself
    is left out of that spread: a number that was changed in its record would widen it.

    Args:
        recorded: the record.
        found: the run that was made again.
        others: the other runs of the bundle.
        protocol: the definitions of PSNR and SSIM.
    """
    known = [list(_numbers(run, protocol)) for run in (recorded, found, *repeats_of(recorded, others))]
    return [
        _compared(quantity, value, again, [number for _, number in rest if number is not None])
        for (quantity, value), (_, again), *rest in zip(*known, strict=True)
        if value is not None or again is not None
    ]


def _compared(quantity: _Quantity, value: float | None, again: float | None, repeats: Sequence[float]) -> Comparison:
    stated = quantity.noise * abs(value or 0.0) if quantity.relative else quantity.noise
    spread = TWO_RUNS * statistics.stdev(repeats) if len(repeats) >= MIN_REPEATS else 0.0
    return Comparison(quantity, value, again, max(stated, spread), len(repeats) if spread > stated else 0)


def repeats_of(run: RunSummary, others: Iterable[RunSummary]) -> list[RunSummary]:
    """Return the runs of the same label, configuration, scene and data with other seeds."""
    return [other for other in others if other.run.seed != run.run.seed and _kind(other) == _kind(run)]


def _kind(run: RunSummary) -> tuple[object, ...]:
    return run.run.label, run.run.config_hash, run.run.data_hash, run.run.split, clip_of(run)


def _numbers(run: RunSummary, protocol: Protocol) -> Iterator[tuple[_Quantity, float | None]]:
    for quantity, metric in (
        (_PSNR, protocol.psnr), (_VEHICLES, protocol.vehicle[0]), (_PEOPLE, protocol.human[0]), (_SSIM, protocol.ssim),
    ):  # fmt: skip
        yield quantity, run.mean(metric)
    yield _GAUSSIANS, float(run.gaussians_total)
    yield _MB, run.bytes_total / 1e6


def verdict(recorded: RunSummary, found: RunSummary, compared: Sequence[Comparison], *, trained: bool) -> str:
    """Say in one line what each number is, and whether the row holds; ``trained``: or measured, in a rounded scene."""
    run = recorded.run
    held = "holds" if all(one.holds for one in compared) else "does not hold"
    same = all(one.found == one.recorded for one in compared)
    unlike = (
        "" if same or not (trained and _alike(recorded, found)) else ", not to the bit, on the same machine and commit"
    )
    title = one_line(f"{run.label}, {run.scene}, seed {run.seed}")
    return f"{title}: {'; '.join(map(str, compared))}: {held}{unlike}"


def _alike(recorded: RunSummary, found: RunSummary) -> bool:
    ours, theirs = ((one.run.machine, one.run.device, one.run.threads, one.run.source) for one in (recorded, found))
    return ours == theirs and not found.run.source.dirty
