"""Measures how steady the machine is while something is timed: a fixed loop before and after, and who used it."""

import os
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from sparsestreet.phases import clock_of
from sparsestreet.records.run import Noise

QUIET_SPREAD, QUIET_DRIFT = 0.1, 0.05
"""A machine is quiet if the loop's times spread by less than the first, and their median drifts by less than the
second.

Medians move far less than single times: two medians of one scene then agree within 5 %."""
QUIET_WAIT, QUIET_OTHERS = 0.02, 0.05
"""Nor is it quiet if the main thread waits for a processor during more than the first part of the time, while other
processes use more than the second of one: the loop, of some milliseconds, can fall between two turns of the others.
Threads of the process itself may keep each other waiting on a quiet machine."""

_WARMUP, _REPEATS = 30, 30
_NUMBERS = {"cpu": 2**17, "cuda": 2**22}
_COSINES = 4
"""Cosines in a round, which takes some tenths of a millisecond.

(A matrix product would leave its workspace on a GPU, where it counts as the run's memory.)"""


@dataclass(frozen=True)
class Use:
    """Seconds of the machine's processors up to one moment."""

    clock: float
    waited: float
    """In which the main thread was ready to run, and others ran."""
    others: float
    """Of all processors together, in which processes other than this one ran (another machine on them, too)."""

    @staticmethod
    def now() -> "Use | None":
        """Read what the system counts; None where it does not (not Linux)."""
        try:
            waited = float(_WAITS.read_text().split()[1]) * 1e-9
            ticks = [float(value) for value in _TICKS.read_text().split("\n", 1)[0].split()[1:9]]
        except (OSError, IndexError, ValueError):
            return None
        user, nice, system, _idle, _io, interrupts, soft, stolen = ticks
        all_of_them = (user + nice + system + interrupts + soft + stolen) / os.sysconf("SC_CLK_TCK")
        return Use(time.perf_counter(), waited, all_of_them - sum(os.times()[:4]))

    def parts_since(self, earlier: "Use") -> tuple[float, float]:
        """The part of the time since then that the main thread waited, and processors that others used meanwhile."""
        seconds = max(self.clock - earlier.clock, 1e-9)
        return (self.waited - earlier.waited) / seconds, max((self.others - earlier.others) / seconds, 0.0)


_WAITS, _TICKS = Path("/proc/self/schedstat"), Path("/proc/stat")
"""Nanoseconds run and waited of the process's main thread; ticks of all processors by what they did."""


@dataclass(frozen=True)
class Calibration:
    """Times of the fixed loop at one moment."""

    milliseconds: float
    """Median of a round."""
    spread: float
    """Ninth decile of the rounds less the first, divided by the median."""
    load_average: float | None
    use: Use | None = None


def calibrate(device: torch.device) -> Calibration:
    """Run the loop on a device: 30 rounds of cosines, after 30 that do not count.

    >>> calibrate(torch.device("cpu")).milliseconds > 0
    True
    """
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    clock = clock_of(device)
    numbers = torch.zeros(_NUMBERS[device.type], device=device)
    marks = []
    for _ in range(_WARMUP + 1 + _REPEATS):
        for _ in range(_COSINES):
            numbers.cos_()
        marks.append(clock.mark())
    times = [1e3 * clock.seconds(*pair) for pair in pairwise(marks[_WARMUP:])]
    first, median, ninth = (float(value) for value in np.percentile(times, (10, 50, 90)))
    return Calibration(median, (ninth - first) / median, load, Use.now())


def noise_between(before: Calibration, after: Calibration) -> Noise:
    """The noise between two calibrations.

    >>> before, after = Calibration(1.0, 0.02, None), Calibration(1.25, 0.03, None)
    >>> noise_between(before, after).drift, noise_between(before, after).quiet
    (0.25, False)
    """
    drift = after.milliseconds / before.milliseconds - 1
    waited, others = after.use.parts_since(before.use) if before.use and after.use else (None, None)
    quiet = max(before.spread, after.spread) < QUIET_SPREAD and abs(drift) < QUIET_DRIFT
    if waited is not None and others is not None:
        quiet = quiet and not (waited > QUIET_WAIT and others > QUIET_OTHERS)
    return Noise(before.spread, after.spread, drift, before.load_average, quiet, waited, others)
