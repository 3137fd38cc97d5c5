"""What ends a sweep whose jobs run beside each other ends each of them behind its step."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sparsestreet.cli import signals
from sparsestreet.cli.signals import end_with_jobs, handlers_put_back, job_beside_others
from sparsestreet.training.callbacks import graceful_stop


@pytest.fixture(autouse=True)
def put_back():
    with handlers_put_back():
        yield


def test_the_signals_are_those_that_training_heeds():
    assert signals._ALL == graceful_stop.SIGNALS


def test_a_job_counts_as_running_until_it_ends(tmp_path):
    with job_beside_others(tmp_path):
        assert signals._runs(tmp_path, os.getpid())
    assert not signals._runs(tmp_path, os.getpid())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / f".job{os.getpid()}").touch()  # of a process that was killed
    assert not signals._runs(tmp_path, os.getpid())
    (tmp_path / ".job7").touch()
    end_with_jobs(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", signals.SIGNALS)
def test_a_signal_ends_a_job_with_its_status_and_those_behind_it_ask_for_nothing(tmp_path, number):
    with pytest.raises(SystemExit) as ended, job_beside_others(tmp_path):
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(signal.SIGTERM)
    assert ended.value.code == 128 + number
    for other in signals.SIGNALS:
        signal.raise_signal(other)  # between two jobs as well: joblib would kill all


@pytest.mark.slow
@pytest.mark.parametrize(("to_all", "number"), [(True, signal.SIGINT), (False, signal.SIGTERM), (True, signal.SIGTERM)])
def test_every_job_of_a_sweep_saves(tiny_street, tmp_path, to_all, number):
    """Ctrl-C reaches all processes, a cluster's signal perhaps the first alone."""
    words = [*tiny_street, f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=seed${seed}", "schedule.max_steps=600"]
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1,2", "data.log.settings.seed=0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "sparsestreet", "train", "-m", *words, *launcher],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    runs = [tmp_path / "seed0", tmp_path / "seed1"]
    while not all(_says(run, "step 60 of 600") for run in runs):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.05)
    (os.killpg if to_all else os.kill)(process.pid, number)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number, output
    assert "2 jobs save after their step" in output
    assert "Traceback" not in output
    for run in runs:
        assert _says(run, "stopped after step")
        assert (run / "checkpoints" / "interrupted.ckpt").is_file()
    assert not (tmp_path / "seed2" / "checkpoints").exists()
    assert not list(tmp_path.glob(".job*"))


def _says(run: Path, words: str) -> bool:
    log = run / "train.log"
    return log.is_file() and words in log.read_text()
