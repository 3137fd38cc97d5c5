"""A metrics.csv that a logger begins anew, kept together."""

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from lightning import Callback, Trainer
from lightning.pytorch.loggers import CSVLogger

from sparsestreet.records.curves import LOGGED, Logged
from sparsestreet.training.callbacks import Checkpoints, newest_checkpoint
from sparsestreet.training.forecast import kept_curves
from sparsestreet.training.run import CPU_TRAINER, fit
from tests.conftest import unchecked
from tests.training.parallel.street import data, system


def write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize("resumed_at", [20, 29])
def test_rows_before_the_checkpoint_stay_and_the_later_ones_are_the_new(tmp_path, resumed_at):
    """The step at which a run goes on is taken again."""
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n11,19\n12,29\n")
    with kept_curves(tmp_path, resumed_at=resumed_at):
        write(path, "psnr,step,val/psnr\n22,29,\n,30,25\n")
    assert path.read_text() == "psnr,step,val/psnr\n10,9,\n11,19,\n22,29,\n,30,25\n"


def test_a_new_run_begins_a_new_file(tmp_path):
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n")
    with kept_curves(tmp_path, resumed_at=None):
        write(path, "psnr,step\n20,9\n")
    assert path.read_text() == "psnr,step\n20,9\n"


def test_they_stay_where_training_stops_again_before_it_logs(tmp_path):
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n")
    with pytest.raises(SystemExit), kept_curves(tmp_path, resumed_at=15):
        path.unlink()
        raise SystemExit
    assert path.read_text() == "psnr,step\n10,9\n"


def test_a_kill_while_a_run_goes_on_takes_no_row(tmp_path):
    """Twice: before Lightning begins its file anew, and when it has logged."""
    path = tmp_path / "curves" / "metrics.csv"
    write(path, "psnr,step\n10,9\n11,19\n")
    killed = kept_curves(tmp_path, resumed_at=15)
    killed.__enter__()
    again = kept_curves(tmp_path, resumed_at=15)
    again.__enter__()
    write(path, "psnr,step,val/psnr\n21,19,\n,20,25\n22,29,\n")
    with kept_curves(tmp_path, resumed_at=25):
        write(path, "psnr,step\n32,29\n")
    assert path.read_text() == "psnr,step,val/psnr\n10,9,\n21,19,\n,20,25\n32,29,\n"
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_without_a_file_there_is_nothing_to_keep(tmp_path):
    with kept_curves(tmp_path, resumed_at=15):
        pass
    assert list(tmp_path.iterdir()) == []


class Kept(Callback):
    """Copies of a run's folder, as kills leave it: before a step, and between its checkpoint and its row."""

    def __init__(self, run: Path, step: int) -> None:
        self.run, self.step = run, step

    def on_train_batch_end(self, trainer: Trainer, *arguments: Any) -> None:
        if trainer.global_step == self.step:
            shutil.copytree(self.run, self.run.parent / "between")

    def on_train_batch_start(self, trainer: Trainer, *arguments: Any) -> None:
        if trainer.global_step == self.step:
            shutil.copytree(self.run, self.run.parent / "behind")


def trained(run: Path, *watch: Callback, start: Path | None = None) -> list[Logged]:
    callbacks = [Checkpoints(run / "checkpoints", every=6), *watch]
    logger = CSVLogger(run, name="", version="curves")
    make = partial(CPU_TRAINER, limit_val_batches=0, log_every_n_steps=3)
    fit(system(), data(), callbacks, make, run, max_steps=12, logger=logger, start=start)
    return LOGGED.rows(run)


@pytest.mark.filterwarnings("ignore:Experiment logs directory")
def test_the_row_of_a_step_is_written_before_its_checkpoint(tmp_path):
    """Lightning logs a step when those who save at its end are done; a kill may come between the two."""
    with unchecked():
        whole = trained(tmp_path / "whole", Kept(tmp_path / "whole", 6))
        assert [row["step"] for row in whole] == ["2", "5", "8", "11"]
        assert [row["step"] for row in LOGGED.rows(tmp_path / "between")] == ["2", "5"]
        for killed in ("between", "behind"):
            run = tmp_path / killed
            assert trained(run, start=newest_checkpoint(run)) == whole
