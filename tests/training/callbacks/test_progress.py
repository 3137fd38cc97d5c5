"""A line per tenth where no terminal listens, a bar where one does."""

import io
import logging
import time

import pytest
import torch
from rich.console import Console

from sparsestreet.training.callbacks import TrainingProgress, progress
from tests.training.stubs import StubTrainer, background, make_system, rigid
from tests.typed import as_a, there


def trainer_of(max_steps: int, resumed_at: int = 0) -> StubTrainer:
    nodes = {"background": background(1200), "rigid": rigid(3)}
    trainer = StubTrainer(make_system(nodes), [TrainingProgress()], max_steps=max_steps)
    trainer.global_step = resumed_at
    return trainer


@pytest.fixture
def seconds(monkeypatch) -> list[float]:
    """What time.perf_counter answers: the last one of the list."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[-1])
    return now


@pytest.mark.parametrize(
    ("max_steps", "steps"),
    [
        (40, [4, 8, 12, 16, 20, 24, 28, 32, 36, 40]),
        (25, [3, 5, 8, 10, 13, 15, 18, 20, 23, 25]),  # the first step of each full tenth
        (3, [1, 2, 3]),
    ],
)
def test_without_a_terminal_there_is_a_line_per_tenth(caplog, max_steps, steps):
    trainer = trainer_of(max_steps)
    with caplog.at_level(logging.INFO):
        trainer.start()
        trainer.walk(max_steps)
    assert [message.split(":")[0] for message in caplog.messages] == [f"step {step} of {max_steps}" for step in steps]


def test_of_several_processes_the_first_alone_shows_it(caplog, monkeypatch):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True)
    monkeypatch.setattr(progress, "Console", lambda: console)
    trainer = trainer_of(10)
    trainer.is_global_zero = False
    with caplog.at_level(logging.INFO):
        trainer.start()
        trainer.walk(10)
    assert (caplog.messages, screen.getvalue()) == ([], "")


def test_a_line_by_hand(caplog, seconds):
    trainer = trainer_of(100, resumed_at=30)
    with caplog.at_level(logging.INFO):
        trainer.start()
        seconds.append(104.0)
        trainer.walk(40)
        trainer.callback_metrics = {"val/psnr": torch.tensor(21.456)}
        as_a(TrainingProgress, trainer.callbacks[0]).on_validation_end(trainer, trainer.system)
        trainer.callback_metrics = {"val/psnr": None}  # it is not read again
        trainer.system.said.say(trainer, {"psnr": torch.tensor(19.0)}, {"gaussians": 5.0})
        seconds.append(104.5)
        trainer.walk(50)
    assert caplog.messages == [
        "step 40 of 100: 2.5 steps/s, background 1,200, rigid 3",
        "step 50 of 100: 20.0 steps/s, train 19.00 dB, held out 21.46 dB (step 40), background 1,200, rigid 3",
    ]


@pytest.mark.parametrize("end", ["teardown", "on_exception"])
def test_on_a_terminal_there_is_one_bar_until_training_ends(monkeypatch, caplog, end):
    screen = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda: Console(file=screen, force_terminal=True, width=200))
    trainer = trainer_of(35, resumed_at=10)
    callback = as_a(TrainingProgress, trainer.callbacks[0])
    with caplog.at_level(logging.INFO):
        trainer.start()
        bar = there(callback._bar)
        assert (bar.tasks[0].completed, bar.tasks[0].total) == (10, 35)
        trainer.walk(19)
        assert bar.tasks[0].completed == 10
        trainer.walk(20)
        assert bar.tasks[0].completed == 20
        assert "rigid 3" in bar.tasks[0].description
        trainer.walk(35)
        assert bar.tasks[0].completed == 35
        last = KeyboardInterrupt() if end == "on_exception" else "fit"
        getattr(callback, end)(trainer, trainer.system, last)
    assert bar.live.is_started is False
    assert screen.getvalue().rstrip().endswith("\x1b[?25h")  # the cursor is shown again
    assert caplog.messages == []
