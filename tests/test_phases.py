"""Phases and stages: time belongs to the innermost one, all of it to some, and nobody pays where nobody records."""

from unittest.mock import Mock

import pytest
import torch

from sparsestreet import phases
from sparsestreet.phases import PhaseRecorder, StageRecorder, phase, stage


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


def test_the_device_measures_milliseconds():
    """``torch.cuda.Event.elapsed_time`` does, and needs an end that has passed."""
    start, end = Mock(spec=torch.cuda.Event), Mock(spec=torch.cuda.Event)
    start.elapsed_time = lambda event: 250.0 if event is end and end.synchronize.called else None
    assert phases.CudaClock().seconds(start, end) == 0.25


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


@pytest.fixture
def watch(monkeypatch):
    """What time.perf_counter answers: its only entry."""
    now = [100.0]
    monkeypatch.setattr(phases.time, "perf_counter", lambda: now[0])
    yield now
    assert phases._stages is None


def test_stages_of_a_command_add_up_from_its_beginning(watch):
    with StageRecorder(since=97.0) as recorder:
        watch[0] += 1
        with stage("train"):
            watch[0] += 2
            with stage("prune/at step 7"), phase("splat"):
                watch[0] += 4
            watch[0] += 8
        with pytest.raises(KeyError), stage("save"):
            watch[0] += 16
            raise KeyError
        with stage("train"):
            watch[0] += 32
        seconds = recorder.seconds()
    assert seconds == {"start": 3.0, "other": 1.0, "train": 42.0, "prune/at step 7": 4.0, "save": 16.0}
    assert sum(seconds.values()) == watch[0] - 97.0


def test_a_stage_that_fails_is_left(watch):
    """As one that could not save: what comes behind it is not a part of it."""
    with StageRecorder() as recorder:
        with pytest.raises(FileNotFoundError), stage("save"):
            watch[0] += 1
            raise FileNotFoundError
        watch[0] += 2
    assert recorder.seconds() == {"save": 1.0, "other": 2.0}


def test_a_command_that_goes_on_adds_what_the_earlier_one_spent(watch):
    with StageRecorder() as recorder:
        with stage("train"):
            watch[0] += 2
        recorder.go_on({"start": 5.0, "train": 7.0})
    assert recorder.seconds() == {"start": 5.0, "train": 9.0}


def test_nobody_records_stages(watch):
    with stage("train"):
        watch[0] += 2
    recorder = StageRecorder()
    with stage("train"):
        watch[0] += 2
    assert recorder.seconds() == {"other": 2.0}
