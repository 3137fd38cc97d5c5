"""The calibration loop, and what it says of a machine."""

import os

import pytest
import torch

from sparsestreet import noise
from sparsestreet.noise import Calibration, Use, calibrate, noise_between


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


@pytest.mark.parametrize(
    ("waited", "others", "quiet"),
    [
        (0.5, 1.5, False),
        (0.0, 1.5, True),  # there are processors enough for all
        (0.5, 0.0, True),  # its own threads are more than the processors
    ],
)
def test_a_machine_that_others_use_is_not_quiet_though_the_loop_fell_between_their_turns(waited, others, quiet):
    before = Calibration(2.0, 0.01, 0.5, Use(100.0, 7.0, 50.0))
    after = Calibration(2.0, 0.01, 0.5, Use(110.0, 7.0 + 10 * waited, 50.0 + 10 * others))
    found = noise_between(before, after)
    assert (found.waited, found.others, found.quiet) == (pytest.approx(waited), pytest.approx(others), quiet)


def test_use_is_read_from_what_the_system_counts(monkeypatch, tmp_path):
    """The guest's time, the ninth and tenth number, is part of the user's."""
    (tmp_path / "waits").write_text("9000000000 2500000000 17\n")
    (tmp_path / "ticks").write_text("cpu  100 20 30 9999 888 4 5 6 70 80\ncpu0 1 2 3 4 5 6 7 8 9 10\n")
    monkeypatch.setattr(noise, "_WAITS", tmp_path / "waits")
    monkeypatch.setattr(noise, "_TICKS", tmp_path / "ticks")
    monkeypatch.setattr(os, "sysconf", lambda name: 10)
    monkeypatch.setattr(os, "times", lambda: os.times_result((1.0, 2.0, 0.25, 0.5, 99.0)))
    found = Use.now()
    assert found is not None
    assert (found.waited, found.others) == (2.5, 16.5 - 3.75)
    (tmp_path / "ticks").unlink()
    assert Use.now() is None
