"""Phases: time belongs to the innermost one, all of it to some, and nobody pays where nobody records."""

import pytest

from sparsestreet import phases
from sparsestreet.phases import PhaseRecorder, phase


class Ticks(phases.WallClock):
    """A clock that a test sets."""

    now = 0.0

    def mark(self) -> float:
        return self.now

    def seconds(self, start: float, end: float) -> float:
        return end - start


@pytest.fixture
def clock():
    yield Ticks()
    assert phases._recorder is None  # nothing is left to the next test


def test_time_belongs_to_the_innermost_phase_and_adds_up(clock):
    recorder = PhaseRecorder(clock, outside="loop")
    recorder.start()
    clock.now = 1.0
    with phase("backward"):
        clock.now = 3.0
        with phase("splat backward"):
            assert recorder.current == "splat backward"
            clock.now = 7.0
        clock.now = 8.0
    with phase("optimizer"):
        clock.now = 24.0
    with phase("backward"):
        clock.now = 24.5
    clock.now = 32.5
    seconds = recorder.stop()
    assert seconds == {"loop": 1.0 + 8.0, "backward": 2.0 + 1.0 + 0.5, "splat backward": 4.0, "optimizer": 16.0}
    assert sum(seconds.values()) == clock.now


def test_what_is_outside_of_start_and_stop_is_not_recorded(clock):
    recorder = PhaseRecorder(clock)
    with phase("before"):
        clock.now = 1.0
        recorder.start()
        clock.now = 2.0
    with phase("across"):
        clock.now = 4.0
        assert recorder.stop() == {"rest": 1.0, "across": 2.0}
        clock.now = 8.0
    recorder.start()
    clock.now = 9.0
    assert recorder.stop() == {"rest": 1.0}


def test_a_phase_that_fails_is_left(clock):
    recorder = PhaseRecorder(clock)
    recorder.start()
    with pytest.raises(KeyError), phase("broken"):
        clock.now = 1.0
        raise KeyError
    clock.now = 3.0
    assert recorder.stop() == {"rest": 2.0, "broken": 1.0}


def test_one_recorder_at_a_time(clock):
    first, second = PhaseRecorder(clock), PhaseRecorder(clock)
    first.start()
    with pytest.raises(RuntimeError, match="stop the other one first"):
        second.start()
    first.stop()
    second.start()
    second.stop()
