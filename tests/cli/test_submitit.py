"""What submitit does to a job that is preempted: its checkpoint is written, and the requeued job goes on."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from submitit.core.utils import DelayedSubmission, JobPaths
from submitit.local.debug import DebugJobEnvironment
from submitit.local.local import LOCAL_REQUEUE_RETURN_CODE, LocalJobEnvironment

from sparsestreet.records.summary import SUMMARY
from sparsestreet.training.callbacks import Checkpoints, GracefulStop
from sparsestreet.training.callbacks.files import SIGNALS
from tests.cli.conftest import ALL_STAGES
from tests.training.callbacks.test_graceful_stop import STEPS, Sends
from tests.training.stubs import background, fit, frame_at, make_system


@pytest.fixture(autouse=True)
def handlers():
    numbers = {*SIGNALS, signal.SIGCONT}
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Job:
    """A training that preemption ends in its second step, as submitit runs it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self) -> None:
        stop = GracefulStop()
        sends = Sends(2, signal.SIGUSR2)
        try:
            fit(make_system({"background": background(5)}), [sends, Checkpoints(self.folder), stop], STEPS, frame_at())
        except SystemExit:
            stop.hand_on()
            raise

    def checkpoint(self) -> DelayedSubmission:
        assert torch.load(self.folder / "interrupted.ckpt", weights_only=False)["global_step"] == 2
        return DelayedSubmission(self)


@pytest.mark.parametrize("environment", [DebugJobEnvironment, LocalJobEnvironment])
def test_a_job_is_requeued_behind_its_checkpoint(tmp_path, monkeypatch, environment):
    """With the handlers that submitit installs before it calls a job."""
    monkeypatch.setenv("SUBMITIT_FOLDER", str(tmp_path))
    for name in ("SUBMITIT_DEBUG_JOB_ID", "SUBMITIT_LOCAL_JOB_ID"):
        monkeypatch.setenv(name, "7")
    job = DelayedSubmission(Job(tmp_path / "checkpoints"))
    job.set_timeout(60, 3)
    paths = JobPaths(tmp_path, "7")
    environment()._handle_signals(paths, job)
    with pytest.raises(SystemExit) as ended:
        job.result()
    assert ended.value.code == (LOCAL_REQUEUE_RETURN_CODE if environment is LocalJobEnvironment else -1)
    assert isinstance(pickle.loads(paths.submitted_pickle.read_bytes()).function, Job)


@pytest.mark.slow
def test_a_preempted_job_of_a_sweep_goes_on_in_its_own_folder(tiny_street, tmp_path):
    """Hydra's launcher, submitit's local executor, and the signal that it sends before a job's time is over."""
    sweep = tmp_path / "sweep"
    words = [*tiny_street, *ALL_STAGES, f"hydra.sweep.dir={sweep}", "hydra.sweep.subdir=job", "schedule.max_steps=300"]
    command = [sys.executable, "-m", "sparsestreet", "train", "-m", "hydra/launcher=submitit_local", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    log = sweep / "job" / "train.log"
    while not (log.exists() and "step 60 of 300" in log.read_text()):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.05)
    (job,) = _tasks(sweep)
    os.kill(job, signal.SIGUSR2)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    said = log.read_text()
    assert said.index("stopped after step") < said.index("Requeued job") < said.index("goes on from its newest")
    assert "step 60 of 300" not in said[said.index("goes on from its newest") :]
    run = SUMMARY.read(sweep / "job").run
    assert (run.steps, run.max_steps) == (300, 300)


def _tasks(sweep: Path) -> list[int]:
    """The processes of submitit that train for a sweep."""
    found: list[Any] = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = line.read_bytes().decode().split("\0")
        except OSError:
            continue  # it has ended
        if "submitit.core._submit" in words and str(sweep) in "".join(words):
            found.append(int(line.parent.name))
    return found
