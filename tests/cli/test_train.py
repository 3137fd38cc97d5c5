"""Training end to end on a tiny street, through the command line."""

import csv
import json
from pathlib import Path

import pytest
import torch

from sparsestreet.cli.compose import CONF
from sparsestreet.cli.evaluate import evaluate
from sparsestreet.cli.train import train

EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_runs(experiment, run_train, tmp_path):
    run_train(tmp_path, f"experiment={experiment}", "trainer.fast_dev_run=2")


def test_adam_of_visible_rows_runs(run_train, tmp_path):
    run_train(tmp_path, "optimization=visible_adam", "trainer.fast_dev_run=2")


def test_training_improves_and_leaves_records(run_train, tmp_path):
    # A budget relative to the error would take most of a scene that is hardly trained.
    out = run_train(tmp_path / "run", "experiment=streetgs_ours", "schedule.background_pruning_db=0.0")
    summary = json.loads((out / "records" / "summary.json").read_text())
    with (out / "curves" / "metrics.csv").open() as file:
        psnr = [float(row["psnr"]) for row in csv.DictReader(file) if row["psnr"]]
    start = json.loads((run_train(tmp_path / "start", "schedule.max_steps=1") / "records" / "summary.json").read_text())
    # 60 steps from gray random rotations: several dB; noise between runs is zero on the CPU.
    assert summary["quality"]["psnr_full"]["mean"] > start["quality"]["psnr_full"]["mean"] + 3
    assert psnr
    assert summary["gaussians_total"] == sum(summary["gaussians"].values())
    assert summary["guards"]["alarms"] == {}
    assert summary["guards"]["rows"]["drawn"] > 0
    assert (out / "pictures" / "sheet.png").is_file()
    assert (out / "curves" / "counts.png").is_file()


def test_evaluation_of_a_finished_run_agrees_with_training(run_train, tmp_path):
    out = run_train(tmp_path / "run", "experiment=streetgs_ours")
    first = json.loads((out / "records" / "summary.json").read_text())
    assert evaluate([f"run={out}"]) == 0
    second = json.loads((out / "records" / "summary.json").read_text())
    assert second["quality"] == first["quality"]
    assert second["gaussians"] == first["gaussians"]
    assert second["run"]["training_seconds"] == first["run"]["training_seconds"]


@pytest.mark.parametrize("stop_at", [23, 50])
def test_resume_equals_the_uninterrupted_run_bit_for_bit(run_train, tmp_path, stop_at):
    """Stopped inside the mask stage (23: between two refinements) and after it (50: the masks are gone)."""
    whole = run_train(tmp_path / "whole", "experiment=streetgs_ours")
    part = _interrupted(tmp_path / "part", run_train, stop_at)
    resumed = run_train(
        tmp_path / "resumed", "experiment=streetgs_ours", f"resume={part / 'checkpoints' / 'interrupted.ckpt'}"
    )
    expected, got = (_weights(run) for run in (whole, resumed))
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        assert torch.equal(value, got[name]), name


def _interrupted(out: Path, run_train, step: int) -> Path:
    """A run that raises after ``step`` steps, as a full disk or a kill would make it."""
    from sparsestreet.training.callbacks import RowLedger

    original = RowLedger.on_train_batch_end

    def stop(self, trainer, *arguments):
        original(self, trainer, *arguments)
        if trainer.global_step == step:
            raise RuntimeError("stopped by the test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RowLedger, "on_train_batch_end", stop)
        patch.setenv("HYDRA_FULL_ERROR", "1")
        with pytest.raises(RuntimeError, match="stopped by the test"):
            run_train(out, "experiment=streetgs_ours")
    return out


def _weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("schedule.max_step=5", "schedule.max_steps"),
        ("nod.background.lidar_points=5", "node"),
        ("experiment=streetgs_our", "streetgs_ours"),
        ("+surprise=1", "surprise"),
    ],
)
def test_an_unknown_key_or_option_is_an_error_that_names_the_nearest(override, said, capsys):
    assert train([override]) == 2
    message = capsys.readouterr().err
    assert said in message
    assert len(message.strip().splitlines()) == 1


def test_bf16_mixed_changes_nothing_where_it_would_hurt(run_train, tmp_path):
    """Masks, losses and the op stay float32: in bfloat16 a logit would stop at -4.0, above the threshold."""
    few = ("experiment=streetgs_ours", "callback=[density_control,row_ledger]", "schedule.max_steps=12")
    mixed = _weights(run_train(tmp_path / "mixed", *few, "trainer.precision=bf16-mixed"))
    full = _weights(run_train(tmp_path / "full", *few))
    logits = mixed["scene.nodes.background.rows.mask_logits"]
    assert logits.dtype == torch.float32
    assert not torch.equal(logits, torch.ones_like(logits))
    for name, value in full.items():
        assert torch.equal(value, mixed[name]), name


def test_the_floor_holds_while_masks_are_trained(run_train, tmp_path):
    """A crushing lambda closes every mask; K_min rows stay open, are kept, and the firing is logged."""
    out = run_train(
        tmp_path,
        "experiment=streetgs_masks",
        "loss.mask_sparsity.weight=1e6",
        "schedule.mask_rate=1.0",
        "node.rigid.mask.visible_only=false",
        "schedule.densify_in.stop=0.1",
        "schedule.cull_in.stop=0.1",
    )
    summary = json.loads((out / "records" / "summary.json").read_text())
    assert summary["gaussians"]["background"] == 200
    assert summary["gaussians"]["rigid"] == 60
    assert "K_min" in (out / "train.log").read_text()


def test_masks_end_with_their_stage(run_train, tmp_path):
    names = _weights(run_train(tmp_path, "experiment=streetgs_ours")).keys()
    assert not [name for name in names if "mask" in name]
