"""A run or a sweep that is killed, whatever it was doing, ends with the records of one that nobody disturbed."""

import csv
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sparsestreet.cli.commands.train import train
from sparsestreet.training.callbacks import RowLedger
from tests.cli.conftest import TIMED_ONCE, TINY_RIGID

KILLS = 5
JOBS = 12
TIMES = {"training_seconds", "seconds", "noise", "latency", "evaluated", "out", "source"}
"""Keys and columns of records that hold times, or when a run was made, and from which state of a checkout."""
REPEATED = "train/moved"
"""Columns of losses that most steps lack: Lightning writes the value of the last step that had one, and forgets it when
a run goes on."""
OF_TIMES = {"latency.csv", "phases.csv", "cost.json"}
OF_WAYS = {".hydra", "checkpoints", "pictures", "counts.png", "held_out.png", "psnr.png", "train.log", "multirun.yaml"}
"""Configurations and pictures hold times; a checkpoint is a way to the end."""


def sweep(folder: Path, street: list[str]) -> list[str]:
    return [
        sys.executable, "-m", "sparsestreet", "train",
        "+sweep=tiny", *street, "data.log.settings.seed=0", *TIMED_ONCE,
        f"hydra.sweep.dir={folder}", "hydra.sweep.subdir=${name}_${seed}",
        "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
        "sparsify=none,removal", "seed=0,1,2,3,4,5", "schedule.max_steps=200", "checkpoint_every=10",
    ]  # fmt: skip


def ended(command: list[str], after: float | None) -> bool:
    """Whether it came to its end; all of its processes are killed after so many seconds."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, env=environment, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        _, errors = process.communicate(timeout=after)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    assert process.returncode == 0, errors
    return True


def content(folder: Path) -> dict[str, Any]:
    """Each file that the runs of a sweep leave, but for its times."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in OF_TIMES)
    of_runs = (path for path in files if not OF_WAYS & set(path.relative_to(folder).parts))
    return {str(path.relative_to(folder)): _read(path, folder) for path in of_runs}


def _read(path: Path, folder: Path) -> Any:
    if path.suffix == ".json":
        return _timeless(json.loads(path.read_text().replace(str(folder), "")))
    if path.suffix == ".csv":
        return [_timeless(row) for row in csv.DictReader(path.read_text().splitlines())]
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(one) for key, one in value.items() if key not in TIMES and not key.startswith(REPEATED)}
    return [_timeless(one) for one in value] if isinstance(value, list) else value


@pytest.mark.slow
def test_a_sweep_killed_at_random_ends_as_an_undisturbed_one(tiny_street, tmp_path):
    """The whole group of processes dies five times, then the command comes to its end."""
    street = [word for word in tiny_street if word.startswith(("data.", "image_points."))]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    started = time.monotonic()
    assert ended(sweep(whole, street), after=None)
    took = time.monotonic() - started
    moments = random.Random(26)
    for _ in range(KILLS):
        # A start takes its seconds before the first job: kills that come earlier would disturb nothing.
        assert not ended(sweep(killed, street), after=moments.uniform(0.1, 0.35) * took)
    assert ended(sweep(killed, street), after=None)
    expected, got = content(whole), content(killed)
    assert len([name for name in expected if name.endswith("summary.json")]) == JOBS
    assert sorted(expected) == sorted(got)
    assert [name for name in expected if expected[name] != got[name]] == []


@pytest.mark.slow
@pytest.mark.parametrize(("to_all", "number"), [(True, signal.SIGINT), (False, signal.SIGTERM)])
def test_a_sweep_that_a_signal_ends_leaves_no_process_behind(tiny_street, tmp_path, to_all, number):
    """Ctrl-C reaches all processes, a cluster's signal perhaps the first alone. Jobs go on from checkpoints."""
    street = [word for word in tiny_street if word.startswith(("data.", "image_points."))]
    command = [*sweep(tmp_path, street), "schedule.max_steps=2000"]
    process = subprocess.Popen(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    while len(list(tmp_path.glob("*/checkpoints/last.ckpt"))) < 2:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.1)
    (os.killpg if to_all else os.kill)(process.pid, number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 128 + number, errors
    with pytest.raises(ProcessLookupError):  # the group has no process any more
        for _ in range(100):
            os.killpg(process.pid, 0)
            time.sleep(0.1)
    assert not list(tmp_path.glob("*/records/summary.json"))


EPOCH = 22
"""Training images of the street: the sixth validation lies at the end of an epoch."""
KILLED_AFTER = {
    "before the first checkpoint": 1,
    "behind a validation and the checkpoint of its step": 4,
    "a step later": 5,
    "where curves were logged since": 10,
    "at the end of an epoch": EPOCH,
    "in the next one": EPOCH + 3,
}
"""Name -> steps that were done."""


@pytest.fixture(scope="module")
def command(tiny_street) -> list[str]:
    short = [
        "schedule.max_steps=30",
        "trainer.val_check_interval=2",
        "checkpoint_every=2",
        "trainer.log_every_n_steps=3",
    ]
    return [*tiny_street, *TINY_RIGID, *short]


@pytest.fixture(scope="module")
def left(command, tmp_path_factory) -> Path:
    """A run, and what a kill would have left of it: copies of its folder as it was between two steps."""
    folder = tmp_path_factory.mktemp("killed")

    def copy(self, trainer, *arguments):
        if trainer.global_step in KILLED_AFTER.values():
            shutil.copytree(
                folder / "whole", folder / f"after{trainer.global_step}", ignore=shutil.ignore_patterns(".lock")
            )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RowLedger, "on_train_batch_start", copy, raising=False)
        assert train([*command, f"out={folder / 'whole'}"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("steps", KILLED_AFTER.values(), ids=KILLED_AFTER)
def test_a_killed_run_ends_with_the_records_of_a_whole_one(command, left, steps):
    out = left / f"after{steps}"
    begun = (out / "checkpoints").exists()
    assert begun == (steps > 1)
    assert train([*command, f"out={out}"]) == 0
    assert ("goes on from its newest checkpoint" in (out / "train.log").read_text()) == begun
    expected, got = content(left / "whole"), content(out)
    assert sorted(expected) == sorted(got)
    assert [name for name in expected if expected[name] != got[name]] == []
