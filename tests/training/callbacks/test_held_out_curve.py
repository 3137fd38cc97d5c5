"""PSNR of held-out views over seconds of training: what a row says, and what a resume keeps."""

import csv

import pytest
import torch

from sparsestreet.metrics.image import psnr
from sparsestreet.phases import StageRecorder
from sparsestreet.scene.rendering import render
from sparsestreet.training.callbacks import Clock, HeldOutCurve, StageTimes
from tests.training.stubs import StubTrainer, background, fit, frame_at, make_system


def rows_of(run):
    with (run / "curves" / "held_out.csv").open() as file:
        return list(csv.DictReader(file))


def validated(tmp_path, callbacks, frame):
    clock = Clock()
    system = make_system({"background": background(5)})
    callbacks = [clock, *callbacks, HeldOutCurve(tmp_path, clock)]
    fit(system, callbacks, 4, frame, limit_val_batches=1, val_check_interval=2, check_val_every_n_epoch=None)
    return rows_of(tmp_path), system, clock


def test_every_validation_is_a_row_of_seconds_step_and_regions(tmp_path):
    """Lightning's check before training is none."""
    vehicle = torch.zeros(16, 32, dtype=torch.bool)
    vehicle[4:, :20] = True
    frame = frame_at(human=torch.zeros_like(vehicle), vehicle=vehicle)
    rows, system, clock = validated(tmp_path, [], frame)
    assert [row["step"] for row in rows] == ["2", "4"]
    first, last = (float(row["seconds"]) for row in rows)
    assert 0 < first <= last <= round(clock.seconds, 3)
    with torch.no_grad():
        image = render(system.scene, frame).rgb.clamp(0, 1)
    expected = psnr(image[vehicle][None], frame.image[vehicle][None].float() / 255)
    # Four decimals; the last validation saw one degree of harmonics less than a finished scene.
    assert float(rows[1]["psnr_vehicle"]) == pytest.approx(expected, abs=0.5)
    assert rows[1]["psnr_full"] != rows[1]["psnr_vehicle"]
    assert rows[1]["psnr_human"] == ""  # its mask is empty


def test_a_run_that_goes_on_keeps_its_rows_and_its_seconds(tmp_path):
    clock = Clock()
    clock.load_state_dict({"seconds": 50.0})
    curve = HeldOutCurve(tmp_path, clock)
    trainer = StubTrainer(make_system({"background": background(5)}), [clock, curve])
    trainer.callback_metrics = {"val/psnr": torch.tensor(20.0)}
    trainer.global_step = 7
    curve.on_validation_end(trainer, trainer.system)
    again = HeldOutCurve(tmp_path, clock)
    again.load_state_dict(curve.state_dict())
    clock.load_state_dict({"seconds": 80.0})
    trainer.global_step = 9
    again.on_validation_end(trainer, trainer.system)
    assert (tmp_path / "curves" / "held_out.csv").read_text().splitlines() == [
        "seconds,step,psnr_full,psnr_human,psnr_vehicle",
        "50.000,7,20.0000,,",
        "80.000,9,20.0000,,",
    ]
    trainer.sanity_checking = True
    again.on_validation_end(trainer, trainer.system)
    assert len(again.looks) == 2


def test_validation_is_a_stage_of_its_own_and_what_was_spent_goes_into_the_checkpoint(tmp_path):
    recorder = StageRecorder()
    times = StageTimes(recorder)
    validated(tmp_path, [times], frame_at())
    seconds = recorder.seconds()
    assert seconds["validate"] > 0
    assert recorder.current == "other"
    later = StageRecorder()
    StageTimes(later).load_state_dict({"seconds": {"train": 40.0, "validate": 2.0}})
    assert later.seconds()["train"] == 40.0
    assert times.state_dict()["seconds"]["validate"] == seconds["validate"]
