"""Phases of a run: which steps are noted, what a validation and an interruption leave of them."""

import csv

import pytest

from sparsestreet import phases
from sparsestreet.training.callbacks import PhaseTimes
from tests.training.stubs import StubTrainer, background, fit, frame_at, make_system

IN_EVERY_STEP = {
    "scene", "splat", "loss photometric", "backward", "splat backward", "ssim backward", "optimizer", "loop",
}  # fmt: skip


def steps_of(path) -> dict[int, set[str]]:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert all(float(row["milliseconds"]) >= 0 for row in rows)
    return {int(row["step"]): {r["phase"] for r in rows if r["step"] == row["step"]} for row in rows}


def test_every_so_many_steps_are_noted(tmp_path):
    times = PhaseTimes(tmp_path / "records" / "phases.csv", every=3)
    fit(make_system({"background": background(5)}), [times], 7, frame_at())
    found = steps_of(tmp_path / "records" / "phases.csv")
    assert found.keys() == {3, 6}
    assert found[3] >= IN_EVERY_STEP
    assert phases._recorder is None


def test_a_validation_is_no_part_of_a_step(tmp_path):
    """Before step 3, which it would fall into."""
    times = PhaseTimes(tmp_path / "phases.csv", every=3)
    system = make_system({"background": background(5)})
    fit(system, [times], 7, frame_at(), limit_val_batches=1, val_check_interval=2, check_val_every_n_epoch=None)
    assert steps_of(tmp_path / "phases.csv").keys() == {6}


def test_a_run_that_goes_on_keeps_what_was_noted(tmp_path):
    times = PhaseTimes(tmp_path / "phases.csv", every=2)
    trainer = StubTrainer(make_system({"background": background(5)}), [times])
    trainer.train(3, frame_at())
    again = PhaseTimes(tmp_path / "phases.csv", every=2)
    again.load_state_dict(times.state_dict())
    times.on_exception(trainer, trainer.system, KeyboardInterrupt())
    assert phases._recorder is None
    assert steps_of(tmp_path / "phases.csv").keys() == {2}
    going_on = StubTrainer(trainer.system, [again])
    going_on.global_step = 3
    going_on.train(3, frame_at())
    again.on_train_end(going_on, going_on.system)
    assert steps_of(tmp_path / "phases.csv").keys() == {2, 6}  # nobody watched the beginning of step 4


def test_no_interval_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="at least 1, got 0"):
        PhaseTimes(tmp_path, every=0)
