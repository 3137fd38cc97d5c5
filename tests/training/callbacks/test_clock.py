"""Seconds of training by a patched clock: validation does not count, a resume does."""

import time

import pytest

from sparsestreet.training.callbacks import Clock
from tests.training.stubs import StubTrainer, background, make_system


class Watch:
    """What time.perf_counter answers."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def watch(monkeypatch) -> Watch:
    watch = Watch()
    monkeypatch.setattr(time, "perf_counter", watch)
    return watch


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def hooks(clock):
    """Calls a hook of the clock."""
    trainer = StubTrainer(make_system({"background": background(1)}), [clock])

    def call(hook: str, sanity_checking: bool = False) -> None:
        trainer.sanity_checking = sanity_checking
        getattr(clock, hook)(trainer, trainer.system)

    return call


def test_validation_does_not_count(watch, clock, hooks):
    assert clock.seconds == 0.0
    hooks("on_train_start")
    watch.now += 3
    assert clock.seconds == 3.0  # it can be read while it runs
    hooks("on_validation_start")
    watch.now += 50
    assert clock.seconds == 3.0
    hooks("on_validation_end")
    watch.now += 2
    hooks("on_validation_start")
    watch.now += 70
    hooks("on_validation_end")
    watch.now += 1
    hooks("on_train_end")
    watch.now += 400
    assert clock.seconds == 6.0


def test_lightnings_sanity_check_before_training_does_not_count(watch, clock, hooks):
    hooks("on_validation_start", sanity_checking=True)
    watch.now += 10
    hooks("on_validation_end", sanity_checking=True)
    watch.now += 10
    assert clock.seconds == 0.0
    hooks("on_train_start")
    watch.now += 4
    assert clock.seconds == 4.0


def test_a_resumed_run_adds_to_the_seconds_of_its_checkpoint(watch, clock, hooks):
    hooks("on_train_start")
    watch.now += 5
    state = clock.state_dict()  # of a checkpoint in the middle
    watch.now += 100
    resumed = Clock()
    resumed.load_state_dict(state)
    assert resumed.seconds == 5.0
    trainer = StubTrainer(make_system({"background": background(1)}), [resumed])
    trainer.start()
    watch.now += 2
    assert resumed.seconds == 7.0
    resumed.on_train_end(trainer, trainer.system)
    assert resumed.state_dict() == {"seconds": 7.0}


def test_a_validation_after_training_does_not_start_it_again(watch, clock, hooks):
    hooks("on_train_start")
    watch.now += 5
    hooks("on_train_end")
    hooks("on_validation_start")
    hooks("on_validation_end")
    watch.now += 9
    assert clock.seconds == 5.0
