"""Runs on a clock of their own: what a step takes is said, and nothing waits."""

import logging
from dataclasses import replace
from functools import partial

import pytest
from lightning import Callback, Trainer

from sparsestreet.evaluation.speed import Timing
from sparsestreet.phases import StageRecorder
from sparsestreet.pruning import OpacityRule
from sparsestreet.records.run import RUN
from sparsestreet.training.callbacks import Pace, Pruning, progress
from sparsestreet.training.forecast import CLOSING_SECONDS
from sparsestreet.training.run import train
from sparsestreet.training.schedule import Course
from sparsestreet.training.system import StreetSystem
from tests.training.stubs import StubTrainer, background, frame_at, make_system
from tests.training.test_run import TRAINER, data, recipe

BEFORE = 5.0
"""Seconds until training starts."""


class Steps(Callback):
    """Counts the steps of a run, and notes when each hundredth of it was done."""

    def __init__(self) -> None:
        self.done = 0
        self.progress: list[float] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        self.done = trainer.global_step
        self.progress.append(pl_module.course.progress(self.done))


class Clocked(StageRecorder):
    """Every step takes a tenth of a second, and twice as much from step 50 on."""

    def __init__(self, steps: Steps) -> None:
        super().__init__()
        self.steps = steps

    def seconds(self) -> dict[str, float]:
        done = self.steps.done
        return {"start": BEFORE, "train": 0.1 * (done + max(done - 50, 0)), "validate": 0.0}


@pytest.fixture
def clocked(monkeypatch):
    """Trials say a tenth of a second for a step, half a second for an image, nothing for a rendering."""
    monkeypatch.setattr(progress, "measured_step", lambda *_: 0.1)
    monkeypatch.setattr(progress, "measured_evaluation", lambda *_: (0.5, 0.0))
    monkeypatch.setattr(progress, "growth_of", lambda _: 1.0)
    return Steps()


def trained(out, steps: Steps, **settings):
    still = replace(recipe(out), callbacks={"steps": steps})  # no Gaussian is added
    return train(still, data(), out, make_trainer=TRAINER, stages=Clocked(steps), **settings)


@pytest.mark.lengthy
def test_a_run_ends_in_the_minutes_it_is_given(tmp_path, clocked, caplog):
    with caplog.at_level(logging.INFO):
        summary = trained(tmp_path, clocked, max_steps=12, minutes=0.5)
    evaluation = 5 * 0.5 + CLOSING_SECONDS
    spent = sum(Clocked(clocked).seconds().values()) + evaluation
    assert spent == pytest.approx(30, rel=0.03)  # the last look is a fortieth of the run before its end
    run = RUN.read(tmp_path)
    assert run == summary.run
    assert run.steps == run.max_steps == clocked.done > 12
    assert clocked.progress == sorted(clocked.progress)
    assert clocked.progress[-1] == 1.0
    # At first, all of the time is thought to hold quick steps.
    assert f"{round((30 - BEFORE - evaluation) / 0.1)} steps" in caplog.text


@pytest.mark.lengthy
def test_without_a_budget_the_steps_are_those_of_the_schedule(tmp_path, clocked, caplog):
    with caplog.at_level(logging.INFO):
        summary = trained(tmp_path, clocked, max_steps=12)
    assert (summary.run.steps, summary.run.max_steps) == (12, 12)
    assert clocked.progress == [step / 12 for step in range(1, 13)]
    size = "some 180 Gaussians (3 times those of now, as no limit holds them)"
    assert f"12 steps, {size}, about 0.0 minutes and 0.1 for evaluation" in caplog.text


@pytest.mark.lengthy
def test_a_budget_that_is_over_takes_two_steps(tmp_path, clocked):
    assert trained(tmp_path, clocked, max_steps=12, minutes=0.01).run.steps == 2


class Pruned(StageRecorder):
    """Two passes of 3 s each."""

    def seconds(self) -> dict[str, float]:
        return {"train": 50.0, "prune/A at step 2": 3.0, "prune/A at step 5": 3.0}


def test_the_pass_of_this_step_is_done():
    pruning = Pruning([0.2, 0.5, 0.8], OpacityRule(keep=3))
    trainer = StubTrainer(make_system({"background": background(4)}), [pruning], max_steps=10, train=(frame_at(),))
    trainer.global_step = 5
    assert Pace(Pruned())._passes(trainer, trainer.system) == pytest.approx(3.0)


def test_a_trial_of_a_few_steps_is_not_forecast(tmp_path, clocked, monkeypatch, caplog):
    def measured(*_):
        raise AssertionError("nothing to forecast")

    monkeypatch.setattr(progress, "measured_step", measured)
    still = replace(recipe(tmp_path), callbacks={})
    with caplog.at_level(logging.INFO):
        train(still, data(), tmp_path, max_steps=12, make_trainer=partial(TRAINER, fast_dev_run=1))
    assert "a step takes" not in caplog.text


def test_a_resumed_run_ends_where_its_budget_said():
    course = Course(12)
    course.change(4, 20)
    resumed, trainer, system = (
        Pace(StageRecorder()),
        TRAINER(max_steps=12, logger=False),
        make_system({"road": background()}),
    )
    system.trainer = trainer
    resumed.load_state_dict({"course": course.state_dict()})
    resumed.on_fit_start(trainer, system)
    assert trainer.max_steps == system.course.steps == 20
    assert system.course.state_dict() == course.state_dict()


def test_a_budget_is_some_time():
    with pytest.raises(ValueError, match="more than 0 minutes, got 0"):
        Pace(StageRecorder(), 0.0, Timing())
