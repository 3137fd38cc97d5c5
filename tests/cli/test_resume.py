"""A run that was stopped goes on exactly where it was, as if nothing had happened."""

import csv
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from sparsestreet.cli.commands.train import train
from sparsestreet.cli.runs.folder import check_resumed, resumed_overrides
from sparsestreet.records.costs import COSTS
from sparsestreet.training.callbacks import RowLedger
from tests.cli.configurations import left_run
from tests.cli.conftest import ALL_STAGES, TINY_RIGID


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def assert_equal(run: Path, other: Path) -> None:
    expected, got = weights(run), weights(other)
    assert expected.keys() == got.keys()
    for name, value in expected.items():
        assert torch.equal(value, got[name]), name


SAMPLED = [
    *TINY_RIGID,
    "sparsify=maskgaussian",
    "schedule.max_steps=40",
    # Of one draw three rows of four come back: some go at each moment.
    "sparsify.mask.draws=1",
    "sparsify.mask.initial_logit=1.0",
]


def stopped_at(step: int, tiny_street: list[str], out: Path, stages: list[str] = ALL_STAGES) -> Path:
    """A run with these stages that failed inside ``step`` + 1, after its frame was drawn."""

    def fails(self, trainer, *arguments):
        if trainer.global_step == step:
            raise RuntimeError("stopped by the test")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RowLedger, "on_train_batch_start", fails, raising=False)
        patch.setenv("HYDRA_FULL_ERROR", "1")
        with pytest.raises(RuntimeError, match="stopped by the test"):
            train([*tiny_street, *stages, f"out={out}"])
    return out


def test_resume_equals_the_uninterrupted_run_bit_for_bit(finished, tiny_street, tmp_path):
    """Stopped inside the mask stage: after a reset, in its pause."""
    goes_on_to_the_same_end(stopped_at(23, tiny_street, tmp_path / "run"), finished)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stages", "step"),
    [(SAMPLED, 23), (["method=pvg"], 17), (["method=deformgs"], 17)],
    ids=["sampled masks", "pvg", "deformgs"],
)
def test_what_is_drawn_in_a_step_is_drawn_again(stages, step, tiny_street, tmp_path):
    """Masks, temporal smoothing and noise of time; 17 lies between two refinements, so that statistics go on too."""
    whole = tmp_path / "whole"
    assert train([*tiny_street, *stages, f"out={whole}"]) == 0
    if stages is SAMPLED:  # rows go before and after the stop
        ledger = csv.DictReader((whole / "records" / "counts.csv").read_text().splitlines())
        assert {"20", "30"} <= {row["step"] for row in ledger if row["reason"] == "mask"}
    goes_on_to_the_same_end(stopped_at(step, tiny_street, tmp_path / "part", stages), whole)


def goes_on_to_the_same_end(part: Path, whole: Path) -> None:
    before = curve(part)
    started = time.perf_counter()
    assert train([f"resume={part}"]) == 0
    assert COSTS.read(part).wall_seconds > time.perf_counter() - started  # what was spent before counts
    assert_equal(whole, part)
    # The curve of before is still there, and the ledger is that of the whole run.
    assert [row for row in curve(part) if row in before] == before
    assert {row["step"] for row in curve(part)} == {row["step"] for row in curve(whole)}
    assert (part / "records" / "counts.csv").read_text() == (whole / "records" / "counts.csv").read_text()


def curve(run: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv, without what is blank in them."""
    with (run / "curves" / "metrics.csv").open(newline="") as file:
        return [{key: value for key, value in row.items() if value} for row in csv.DictReader(file)]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_after_the_step_with_its_own_status(finished, tiny_street, tmp_path, number, status):
    """In a process of its own, at whatever moment of a step the signal comes; then it goes on to the same end."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "sparsestreet", "train", *tiny_street, *ALL_STAGES, f"out={out}"]
    environment = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)
    for line in process.stdout:
        if "step 6 of 60" in line:
            break
    time.sleep(0.05)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == status, errors
    assert (out / "checkpoints" / "interrupted.ckpt").is_file()
    assert (out / "scene.safetensors").is_file()
    assert train([f"resume={out}"]) == 0
    assert not (out / "checkpoints" / "interrupted.ckpt").exists()
    assert_equal(finished, out)


def test_another_configuration_is_refused_and_nothing_is_touched(finished, capsys):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    assert train([f"resume={finished}", "schedule.lambda_m=3.0"]) == 2
    assert "schedule.lambda_m" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({"trainer": {"accelerator": "gpu", "max_time": "00:01:00:00"}}, None),
        ({"evaluation": {"novel": [1.0]}}, None),
        ({"weight": 2.0}, r"but 1 options differ: weight \(1\.0 before\)"),
        (
            {"seed": 4, "c": 1, "d": 2},
            r"but 3 options differ: seed \(3 before\), c \(None before\), d \(None before\);",
        ),
    ],
    ids=["where it trains", "what is measured", "an option", "several"],
)
def test_what_may_change_when_a_run_goes_on(tmp_path, change, refused):
    config = {"seed": 3, "weight": 1.0, "trainer": {"accelerator": "cpu", "max_time": None}, "folder": str(tmp_path)}
    (tmp_path / ".hydra").mkdir()
    OmegaConf.save(config, tmp_path / ".hydra" / "config.yaml")
    with nullcontext() if refused is None else pytest.raises(ValueError, match=refused):
        check_resumed(config | change, tmp_path)


def test_a_run_goes_on_with_its_own_words_then_those_that_are_given(tmp_path):
    run = left_run(tmp_path / "run", "seed=3", "out=old", "resume=null", "a.b=1", config={"seed": 3, "a": {"b": 1}})
    own = ["seed=3", "a.b=1"]
    assert resumed_overrides([f"resume={run}", "c=2"]) == [*own, f"resume={run}", "c=2", f"out={run}"]
    checkpoint = run / "checkpoints" / "last.ckpt"
    assert resumed_overrides([f"resume={checkpoint}"]) == [*own, f"resume={checkpoint}", f"out={run}"]
    assert resumed_overrides([f"resume={run}", "out=else"]) == [*own, f"resume={run}", "out=else"]
    for words in (["seed=1"], ["resume=null"], ["resume="], []):
        assert resumed_overrides(words) == words


def test_what_cannot_go_on_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing: there is nothing; give a run's folder or one of its check"):
        resumed_overrides([f"resume={tmp_path / 'nothing'}"])
    with pytest.raises(FileNotFoundError, match=r"is no run: it has no \.hydra/config\.yaml; give a folder that train"):
        resumed_overrides([f"resume={tmp_path}"])
    for flag in ("-m", "--multirun"):
        with pytest.raises(ValueError, match="a sweep cannot go on with one run: leave out -m or resume"):
            resumed_overrides([flag, f"resume={tmp_path}"])
