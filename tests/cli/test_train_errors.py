"""Slips of `sparsestreet train` that end in one line, and the words another process is started with."""

import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest
import torch
from lightning.fabric.strategies.launchers.subprocess_script import _hydra_subprocess_cmd
from omegaconf import DictConfig

from sparsestreet.cli.commands.train import train


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["schedule.max_step=5"], "schedule.max_steps"),
        (["data=drivestudio"], "data.root has no value"),
        (["schedule.max_steps=abc"], "must be a whole number, 1 or more, got 'abc'"),
        (["resume=/nowhere/at/all"], "there is nothing"),
        (["--experimental-rerun=run/.hydra/config.pickle"], "--experimental-rerun is no flag"),
        (
            ["++loss.mine._target_=mypaper.Loss"],
            "loss.mine._target_: there is no module mypaper; is its folder in PYTHONPATH?",
        ),
        (["++loss.mine._target_=tests.cli.toy.Kite"], "loss.mine._target_ names tests.cli.toy.Kite, which cannot be"),
        (["out=/proc/nope/run"], "/proc/nope/run cannot be written ("),
        ([f"out=/tmp/{'x' * 300}"], "cannot be written (File name too long): name another place"),
    ],
)
def test_a_slip_is_one_line_before_hydra_sees_it(overrides, said, tmp_path, capsys):
    assert train([f"out={tmp_path / 'run'}", *overrides]) == 2
    written = capsys.readouterr().err
    assert said in written
    assert written.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_log_that_cannot_be_read_is_one_line(tmp_path, capsys):
    """It is found inside of Hydra, whose report of an error must not be seen."""
    with pytest.raises(SystemExit) as ended:
        train(["data=drivestudio", "data.root=/nowhere/at/all", f"out={tmp_path / 'run'}"])
    assert ended.value.code == 1
    written = capsys.readouterr().err
    assert "/nowhere/at/all" in written
    assert "Traceback" not in written
    assert "Error in call" not in written
    assert not (tmp_path / "run").exists()


def test_where_memory_does_not_do_it_is_one_line(tmp_path, capsys, monkeypatch):
    def out_of_memory(*told):
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate 2.00 GiB")

    monkeypatch.setattr("sparsestreet.cli.runs.run.run", out_of_memory)
    with pytest.raises(SystemExit) as ended:
        train([f"out={tmp_path / 'run'}"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.splitlines() == [
        "sparsestreet train: memory is out (CUDA out of memory. Tried to allocate 2.00 GiB): ask for smaller images or "
        "fewer Gaussians"
    ]


@pytest.mark.slow
def test_another_process_is_started_with_the_words_of_the_job(tmp_path, monkeypatch):
    """By Lightning's launcher, which is asked for the words alone; of a sweep each job has its own."""
    started = []

    def ask(cfg: DictConfig, out: Path, started_at: float) -> float:
        for module in (None, ModuleSpec("sparsestreet.__main__", None)):  # the installed script; python -m
            monkeypatch.setattr(sys.modules["__main__"], "__spec__", module)
            started.append(_hydra_subprocess_cmd(local_rank=1)[0])
        return 0.0

    monkeypatch.setattr("sparsestreet.cli.runs.run.run", ask)
    for check in ("override_problem", "_problem_of_values"):  # half of the test's time
        monkeypatch.setattr(f"sparsestreet.cli.commands.train.{check}", lambda words: None)
    monkeypatch.setattr(sys, "argv", ["/there/bin/sparsestreet", "train", "-m"])
    assert train(["method=3dgs", "seed=1", f"out={tmp_path / 'one'}"]) == 0
    assert train(["-m", "method=3dgs", "seed=2,3", f"hydra.sweep.dir={tmp_path}"]) == 0
    programs = [sys.executable, "/there/bin/sparsestreet"], [sys.executable, "-m", "sparsestreet.__main__"]
    words = [command[: command.index("train") + 3] for command in started]
    assert words == [[*program, "train", "method=3dgs", f"seed={seed}"] for seed in (1, 2, 3) for program in programs]
    assert f'hydra.run.dir="{tmp_path / "one"}"' in started[0]
