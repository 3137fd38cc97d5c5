"""Measures how steady the machine is, by a fixed loop before and after what is timed."""

import os
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from sparsestreet.phases import clock_of
from sparsestreet.records.run import Noise

QUIET_SPREAD, QUIET_DRIFT = 0.1, 0.05
"""A machine is quiet if the loop's times spread by less than the first, and their median drifts by less than the
second.

Medians move far less than single times: two medians of one scene then agree within 5 %."""

_WARMUP, _REPEATS = 30, 30
_NUMBERS = {"cpu": 2**17, "cuda": 2**22}
_COSINES = 4
"""Cosines in a round, which takes some tenths of a millisecond.

(A matrix product would leave its workspace on a GPU, where it counts as the run's memory.)"""


@dataclass(frozen=True)
class Calibration:
    """Times of the fixed loop at one moment."""

    milliseconds: float
    """Median of a round."""
    spread: float
    """Ninth decile of the rounds less the first, divided by the median."""
    load_average: float | None


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
    return Calibration(median, (ninth - first) / median, load)


def noise_between(before: Calibration, after: Calibration) -> Noise:
    """The noise between two calibrations.

    >>> before, after = Calibration(1.0, 0.02, None), Calibration(1.25, 0.03, None)
    >>> noise_between(before, after).drift, noise_between(before, after).quiet
    (0.25, False)
    """
    drift = after.milliseconds / before.milliseconds - 1
    quiet = max(before.spread, after.spread) < QUIET_SPREAD and abs(drift) < QUIET_DRIFT
    return Noise(before.spread, after.spread, drift, before.load_average, quiet)
