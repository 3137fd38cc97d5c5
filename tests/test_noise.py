"""The calibration loop, and what it says of a machine."""

import pytest
import torch

from sparsestreet import noise
from sparsestreet.noise import Calibration, calibrate, noise_between


def test_the_loop_is_timed_by_its_rounds(monkeypatch):
    """A clock that makes the rounds of the warm-up, and one behind it, ten times as long as the others."""

    class Ticks:
        now = 0.0
        marks = 0

        def mark(self):
            Ticks.marks += 1
            Ticks.now += 0.020 if Ticks.marks <= 30 or Ticks.marks == 40 else 0.002
            return Ticks.now

        def seconds(self, start, end):
            return end - start

    monkeypatch.setattr(noise, "clock_of", lambda device: Ticks())
    found = calibrate(torch.device("cpu"))
    assert found.milliseconds == pytest.approx(2.0)
    assert found.spread == pytest.approx(0.0, abs=1e-9)  # one slow round of 30 is beyond the ninth decile
    assert Ticks.marks == 61
    assert found.load_average is None or found.load_average >= 0


def test_the_loop_takes_no_random_numbers():
    """A training between two calibrations is the training."""
    before = torch.get_rng_state()
    assert calibrate(torch.device("cpu")).milliseconds > 0
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    ("before", "after", "drift", "quiet"),
    [
        (Calibration(2.0, 0.01, 0.5), Calibration(2.02, 0.02, 0.7), 0.01, True),
        (Calibration(2.0, 0.2, 0.5), Calibration(2.0, 0.02, 0.7), 0.0, False),
        (Calibration(2.0, 0.01, 0.5), Calibration(2.0, 0.2, 0.7), 0.0, False),
        (Calibration(2.0, 0.01, 0.5), Calibration(2.4, 0.02, 0.7), 0.2, False),
        (Calibration(2.0, 0.01, 0.5), Calibration(1.6, 0.02, 0.7), -0.2, False),
    ],
)
def test_quiet_is_little_spread_and_little_drift(before, after, drift, quiet):
    found = noise_between(before, after)
    assert (found.before, found.after, found.load_average) == (before.spread, after.spread, 0.5)
    assert found.drift == pytest.approx(drift)
    assert found.quiet is quiet
