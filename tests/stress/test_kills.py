"""SIGKILL at any moment: the same command, said again until it is done, leaves what an undisturbed run leaves."""

import random
import time
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import pytest
import torch

from sparsestreet.training.callbacks import Checkpoints, newest_checkpoint
from sparsestreet.training.run import CPU_TRAINER
from tests.cli.conftest import TINY_RIGID
from tests.cli.test_killed_sweep import content, ended, sweep
from tests.stress.forked import Forked, command
from tests.training.parallel.street import train

KILLS_OF_RUNS, KILLS_OF_A_SWEEP = 40, 10
MOST = 5
"""Kills of one run: then it may end."""


def assert_same(whole: Path, killed: Path) -> None:
    expected, got = content(whole), content(killed)
    assert sorted(expected) == sorted(got)
    assert [name for name in expected if expected[name] != got[name]] == []
    assert [str(path) for path in killed.rglob("*") if ".tmp" in path.name] == []


def from_seed(seed: int) -> Iterator[float]:
    """Moments as shares of an undisturbed run."""
    source = random.Random(seed)
    while True:
        yield source.random()


@pytest.mark.stress
@pytest.mark.parametrize("sparsify", ["none", "removal"])
def test_runs_that_are_killed(sparsify, tiny_street, tmp_path):
    words = ["train", *tiny_street, *TINY_RIGID, f"sparsify={sparsify}", "schedule.removal_db=0.0"]
    words += ["trainer.val_check_interval=15", "checkpoint_every=10"]
    whole = command([*words, f"out={tmp_path / 'whole'}"], tmp_path / "log")
    assert whole.status == 0, whole.said
    moments, killed = from_seed(34), 0
    for number in count():
        run = tmp_path / f"run{number}"
        for attempt in count():
            forked = Forked(partial(_main, [*words, f"out={run}"]), tmp_path / f"log{number}.{attempt}")
            last = attempt == MOST or killed == KILLS_OF_RUNS // 2
            found = forked.join() if last else forked.join(kill_after=0.8 * next(moments) * whole.seconds)
            assert "Traceback" not in found.said
            killed += found.status == -9
            # The kill before may have come behind the last file.
            if found.status == 0 or (found.status == 2 and "holds this very run, finished" in found.said):
                break
            assert found.status == -9, found.said
        assert_same(tmp_path / "whole", run)
        if killed == KILLS_OF_RUNS // 2:
            break
    print(f"{killed} kills of {number + 1} runs, each of {whole.seconds:.1f} s")


@pytest.mark.stress
def test_a_sweep_that_is_killed(tiny_street, tmp_path):
    """All processes at once; jobs run beside each other."""
    street = [word for word in tiny_street if word.startswith(("data.", "image_points."))]
    jobs = ["seed=0,1,2", "schedule.max_steps=100"]
    whole = tmp_path / "whole"
    started = time.monotonic()
    assert ended([*sweep(whole, street), *jobs], after=None)
    took = time.monotonic() - started
    moments, killed = from_seed(26), 0
    for number in count():
        folder = tmp_path / f"sweep{number}"
        words = [*sweep(folder, street), *jobs]
        while killed < KILLS_OF_A_SWEEP and not ended(words, after=(0.1 + 0.5 * next(moments)) * took):
            killed += 1
        assert ended(words, after=None)
        assert_same(whole, folder)
        if killed == KILLS_OF_A_SWEEP:
            break
    print(f"{killed} kills of {number + 1} sweeps, each of {took:.0f} s")


@pytest.mark.lengthy
def test_the_short_form(tmp_path):
    """A training without data, killed three times."""

    def trained(folder: Path) -> None:
        begun = (folder / "checkpoints").is_dir() and any((folder / "checkpoints").glob("[!.]*.ckpt"))
        found = train(
            folder,
            partial(CPU_TRAINER, limit_val_batches=0),
            [Checkpoints(folder / "checkpoints", 6)],
            newest_checkpoint(folder) if begun else None,
        )
        torch.save(found["parameters"], folder / "parameters.pt")

    whole = Forked(partial(trained, tmp_path / "whole"), tmp_path / "log").join()
    assert whole.status == 0, whole.said
    moments, killed = from_seed(3), tmp_path / "killed"
    statuses = [
        Forked(partial(trained, killed), tmp_path / "log").join(kill_after=next(moments) * whole.seconds).status
        for _ in range(3)
    ]
    assert -9 in statuses
    found = Forked(partial(trained, killed), tmp_path / "log").join()
    assert found.status == 0, found.said
    expected, got = (torch.load(run / "parameters.pt", weights_only=True) for run in (tmp_path / "whole", killed))
    assert expected.keys() == got.keys()
    assert all(torch.equal(value, got[name]) for name, value in expected.items())


def _main(words: list[str]) -> None:
    from sparsestreet.cli import main

    main(words)
