"""What a step says reaches the loggers once, under its own step, when it has arrived."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sparsestreet.host_copy import HostCopy
from sparsestreet.training import nonfinite
from sparsestreet.training.nonfinite import SaidLater
from tests.training.stubs import StubTrainer, background, make_system


@dataclass(frozen=True)
class Late(HostCopy):
    """A copy that is never there by itself."""

    @property
    def ready(self) -> bool:
        return False


@pytest.fixture
def trainer() -> StubTrainer:
    return StubTrainer(make_system({"background": background(3)}))


def value(number: float) -> dict[str, Tensor]:
    return {"loss": torch.tensor(number)}


def test_a_step_is_passed_on_when_it_is_over_and_once(trainer: StubTrainer):
    said = SaidLater()
    trainer.global_step, trainer.current_epoch = 4, 2
    said.say(trainer, value(0.5), {"rows": 3.0})
    assert said.newest == {"loss": 0.5, "rows": 3.0}
    said.pass_on(trainer)
    assert trainer.log_calls == []  # the step runs
    trainer.global_step, trainer.current_epoch = 5, 3
    said.pass_on(trainer)
    said.pass_on(trainer)
    expected = [("loss", 0.5), ("rows", 3.0), ("epoch", 2)]
    assert trainer.log_calls == [(name, number, {"step": 4}) for name, number in expected]
    assert said.newest == {"loss": 0.5, "rows": 3.0}


def test_of_several_images_of_a_step_the_last_is_heard(trainer: StubTrainer):
    said = SaidLater()
    for number in (0.5, 0.25):
        said.say(trainer, value(number), {})
    trainer.global_step += 1
    said.pass_on(trainer)
    assert [number for name, number, _ in trainer.log_calls if name == "loss"] == [0.25]


def test_what_is_on_its_way_is_not_the_newest(trainer: StubTrainer, monkeypatch: pytest.MonkeyPatch):
    said = SaidLater()
    said.say(trainer, value(0.5), {})
    trainer.global_step += 1
    said.pass_on(trainer)
    monkeypatch.setattr(nonfinite, "copy_to_host", lambda values: Late(values, None))
    said.say(trainer, value(0.25), {})
    assert (said.is_there, said.newest) == (False, {"loss": 0.5})


def test_float64_keeps_its_digits(trainer: StubTrainer):
    """PSNR is one, losses are float32."""
    said, exact = SaidLater(), 20.935264143691782
    said.say(trainer, {"psnr": torch.tensor(exact, dtype=torch.float64), "loss": torch.tensor(0.1)}, {})
    assert said.newest == {"psnr": exact, "loss": torch.tensor(0.1).item()}


def test_rows_are_written_before_what_follows_them(trainer: StubTrainer):
    """On a device a row waits for the next step; validation, a checkpoint and the end bring it first."""
    for hook in ("on_validation_start", "on_train_end", "on_save_checkpoint"):
        trainer.log_calls.clear()
        trainer.system.said.say(trainer, value(0.5), {})
        trainer.global_step += 1
        getattr(trainer.system, hook)(*([{}] if hook == "on_save_checkpoint" else []))
        assert [name for name, _, _ in trainer.log_calls] == ["loss", "epoch"]
