"""counts.csv by hand, and when it is written."""

from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from sparsestreet.records.curves import LEDGER
from sparsestreet.scene.density import GradientDensity
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.masks import StaticMaskSettings
from sparsestreet.training.callbacks import DensityControl, MaskTraining, RowLedger
from sparsestreet.training.callbacks.density_control import resize_rows
from sparsestreet.training.schedule import Interval
from tests.training.stubs import StubTrainer, background, fit, frame_at, make_system, rigid, set_rows


def keep(*rows: bool) -> RowPlan:
    return RowPlan.keep(torch.tensor(rows))


@pytest.fixture
def trainer(tmp_path) -> StubTrainer:
    """Four standing and three moving rows; the ledger is the first of its callbacks."""
    system = make_system({"background": background(4), "rigid": rigid(3)})
    return StubTrainer(system, [RowLedger(tmp_path / "records" / "counts.csv")])


def change_rows(trainer: StubTrainer) -> None:
    """At step 2 a row is doubled, at step 5 one goes, and one is put in the place of another."""
    trainer.walk(2)
    doubled = RowPlan(4, torch.tensor([0, 1, 2, 3, 3]), torch.tensor([False] * 4 + [True]))
    resize_rows(trainer, trainer.system, "background", doubled, "densify")
    resize_rows(trainer, trainer.system, "rigid", keep(True, True, True), "cull")
    trainer.walk(5)
    resize_rows(trainer, trainer.system, "background", keep(True, False, False, True, True), "mask")
    swapped = RowPlan(3, torch.tensor([0, 0, 2]), torch.tensor([False, True, False]))
    resize_rows(trainer, trainer.system, "rigid", swapped, "densify")
    resize_rows(trainer, trainer.system, "rigid", keep(True, False, True), "outside its box")


WHOLE = """\
step,node,before,after,reason
0,background,0,4,start
0,rigid,0,3,start
2,background,4,5,densify
5,background,5,3,mask
5,rigid,3,2,outside its box
"""


@pytest.mark.parametrize("end", [("on_train_end",), ("on_exception", KeyboardInterrupt())], ids=lambda end: end[0])
def test_the_file_by_hand(trainer, tmp_path, end):
    """A line for every change of a number; where the number stays there is nothing to say."""
    trainer.start()
    change_rows(trainer)
    hook, *exception = end
    getattr(trainer.callbacks[0], hook)(trainer, trainer.system, *exception)
    assert (tmp_path / "records" / "counts.csv").read_text() == WHOLE


class Fails(Callback):
    def on_train_batch_end(self, trainer: Trainer, *args: Any) -> None:
        raise RuntimeError("stop")


def test_lightning_says_so_when_training_fails(tmp_path):
    system = make_system({"background": background(4)})
    with pytest.raises(RuntimeError, match="stop"):
        fit(system, [RowLedger(tmp_path / "counts.csv"), Fails()], 3, frame_at())
    assert (tmp_path / "counts.csv").read_text().splitlines()[1:] == ["0,background,0,4,start"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("no space left on device")])
def test_what_fails_before_the_start_or_on_a_full_disk_leaves_an_older_file_alone(trainer, tmp_path, error):
    path = tmp_path / "records" / "counts.csv"
    path.parent.mkdir()
    path.write_text("older")
    if isinstance(error, OSError):
        trainer.start()
    trainer.callbacks[0].on_exception(trainer, trainer.system, error)
    assert path.read_text() == "older"


def test_other_processes_write_nothing(trainer, tmp_path):
    trainer.start()
    trainer.is_global_zero = False
    trainer.callbacks[0].on_train_end(trainer, trainer.system)
    trainer.callbacks[0].on_exception(trainer, trainer.system, KeyboardInterrupt())
    assert not (tmp_path / "records").exists()


def test_a_resumed_run_goes_on_with_the_changes_of_its_checkpoint(trainer, tmp_path):
    trainer.start()
    change_rows(trainer)
    ledger = trainer.callbacks[0]
    torch.save(ledger.state_dict(), tmp_path / "state.pt")
    resumed = RowLedger(tmp_path / "resumed.csv")
    later = StubTrainer(make_system({"background": background(3), "rigid": rigid(2)}), [resumed])
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    later.start()
    later.walk(7)
    resize_rows(later, later.system, "rigid", keep(False, True), "cull")
    resumed.on_train_end(later, later.system)
    assert (tmp_path / "resumed.csv").read_text() == WHOLE + "7,rigid,2,1,cull\n"


def test_the_changes_of_a_training_are_a_chain(tmp_path):
    """Whatever density control and masks do: each line begins where the one before it of its node ended."""
    density = GradientDensity(grad_threshold=1e-4, split_scale=0.01, cull_opacity=0.3)
    nodes = {
        "background": background(20, mask=StaticMaskSettings(1.0), density=density),
        "rigid": rigid(8, density=density),
    }
    set_rows(nodes["background"], "mask_logits", {2: -9.0, 5: -9.0})
    system = make_system(nodes)
    control = DensityControl(Interval(0.0, 1.0, every=2), 1.0, Interval(0.0, 0.0))
    ledger = RowLedger(LEDGER.path(tmp_path))
    trainer = StubTrainer(system, [ledger, control, MaskTraining(Interval(0.0, 1.0, every=3))], max_steps=6)
    trainer.start()
    trainer.train(6, frame_at())
    ledger.on_train_end(trainer, system)
    changes = LEDGER.read(tmp_path)
    reached = {"background": 0, "rigid": 0}
    for change in changes:
        assert change.before == reached[change.node] != change.after, change
        reached[change.node] = change.after
    assert reached == system.scene.counts()
    assert {change.reason for change in changes} == {"start", "densify", "cull", "outside its box", "mask"}
    assert [change.step for change in changes] == sorted(change.step for change in changes)
    assert [change.step for change in changes if change.reason == "mask"] == [3]
