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


def test_validation_does_not_count(watch):
    """Lightning's check before training neither, nor what somebody validates behind its end."""
    trainer = StubTrainer(make_system({"background": background(1)}), [clock := Clock()])

    def after(hook: str, seconds: int) -> float:
        trainer.sanity_checking = clock.seconds == 0.0
        getattr(clock, hook)(trainer, trainer.system)
        watch.now += seconds
        return clock.seconds  # it can be read while it runs

    assert after("on_validation_start", 10) == after("on_validation_end", 10) == 0.0
    assert after("on_train_start", 3) == after("on_validation_start", 50) == 3.0
    assert after("on_validation_end", 2) == after("on_validation_start", 70) == 5.0
    assert after("on_validation_end", 1) == after("on_train_end", 400) == 6.0
    assert after("on_validation_start", 9) == after("on_validation_end", 9) == 6.0


def test_a_resumed_run_adds_to_the_seconds_of_its_checkpoint(watch):
    first, resumed = Clock(), Clock()
    StubTrainer(make_system({"background": background(1)}), [first]).start()
    watch.now += 5
    state = first.state_dict()  # of a checkpoint in the middle
    watch.now += 100
    resumed.load_state_dict(state)
    assert resumed.seconds == 5.0
    trainer = StubTrainer(make_system({"background": background(1)}), [resumed])
    trainer.start()
    watch.now += 2
    assert resumed.seconds == 7.0
    resumed.on_train_end(trainer, trainer.system)
    assert resumed.state_dict() == {"seconds": 7.0}
