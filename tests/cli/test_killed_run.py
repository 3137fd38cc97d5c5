"""A run that is killed between two steps goes on from its newest checkpoint, to the records of a whole one."""

import shutil
from pathlib import Path

import pytest

from sparsestreet.cli.commands.train import train
from sparsestreet.training.callbacks import RowLedger
from tests.cli.conftest import TINY_RIGID
from tests.cli.test_killed_sweep import content

EPOCH = 22
"""Training images of the street: the sixth validation lies at the end of an epoch."""
KILLS = {
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
        if trainer.global_step in KILLS.values():
            shutil.copytree(
                folder / "whole", folder / f"after{trainer.global_step}", ignore=shutil.ignore_patterns(".lock")
            )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RowLedger, "on_train_batch_start", copy, raising=False)
        assert train([*command, f"out={folder / 'whole'}"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("steps", KILLS.values(), ids=KILLS)
def test_a_killed_run_ends_with_the_records_of_a_whole_one(command, left, steps):
    out = left / f"after{steps}"
    begun = (out / "checkpoints").exists()
    assert begun == (steps > 1)
    assert train([*command, f"out={out}"]) == 0
    assert ("goes on from its newest checkpoint" in (out / "train.log").read_text()) == begun
    expected, got = content(left / "whole"), content(out)
    assert sorted(expected) == sorted(got)
    assert [name for name in expected if expected[name] != got[name]] == []
