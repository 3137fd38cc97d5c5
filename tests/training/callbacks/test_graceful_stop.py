"""A signal ends training after the step that is under way; the process has its own handlers back afterwards."""

import signal
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from sparsestreet.training.callbacks import Checkpoints, GracefulStop
from sparsestreet.training.callbacks.graceful_stop import SIGNALS, TornStop
from tests.training.stubs import background, fit, frame_at, make_system

STEPS = 4


@pytest.fixture(autouse=True)
def handlers() -> Iterator[dict[int, Any]]:
    """Those of the process, put back whatever a test leaves."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    # A shell starts its background jobs with SIGINT ignored, and Python then leaves it so.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield {number: signal.getsignal(number) for number in SIGNALS}
    for number, handler in before.items():
        signal.signal(number, handler)


def present() -> dict[int, Any]:
    return {number: signal.getsignal(number) for number in SIGNALS}


class Sends(Callback):
    """Signals to this process, or an exception, in the middle of a step: after backward, before the optimizer."""

    def __init__(self, step: int, *numbers: int, exception: Exception | None = None) -> None:
        self.step, self.numbers, self.exception = step, numbers, exception
        self.within: dict[int, Any] = {}

    def on_after_backward(self, trainer: Trainer, pl_module: Any) -> None:
        self.within = present()
        if trainer.global_step + 1 == self.step:
            for number in self.numbers:
                signal.raise_signal(number)
            if self.exception is not None:
                raise self.exception


def train(folder: Any, sends: Sends) -> tuple[Any, GracefulStop]:
    """A training of four steps with the callbacks as a run orders them."""
    stop = GracefulStop()
    system = make_system({"background": background(5)})
    fit(system, [sends, Checkpoints(folder), stop], STEPS, frame_at())
    return system, stop


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_training_after_its_step(tmp_path, handlers, number, status):
    stop = GracefulStop()
    system = make_system({"background": background(5)}, sh_interval=1.0)  # else some columns start late
    with pytest.raises(SystemExit):
        fit(system, [Sends(2, number), Checkpoints(tmp_path), stop], STEPS, frame_at())
    assert stop.exit_status == status
    saved = torch.load(tmp_path / "interrupted.ckpt", weights_only=False)
    assert saved["global_step"] == 2
    state = saved["optimizer_states"][0]["state"]
    assert {float(moments["step"]) for moments in state.values()} == {2.0}  # the whole of the second step
    assert not (tmp_path / "last.ckpt").exists()
    assert present() == handlers


class SendsBefore(Callback):
    """A signal while Lightning tries the validation out, before training starts."""

    def __init__(self, number: int) -> None:
        self.number = number

    def on_sanity_check_start(self, trainer: Trainer, pl_module: Any) -> None:
        signal.raise_signal(self.number)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_before_training_has_its_status_as_well(handlers, number, status):
    stop = GracefulStop()
    system = make_system({"background": background(5)})
    with pytest.raises(SystemExit):
        fit(system, [SendsBefore(number), stop], STEPS, frame_at(), limit_val_batches=1)
    assert stop.exit_status == status
    assert present() == handlers


@pytest.mark.parametrize(("first", "second"), [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM, signal.SIGINT)])
def test_a_second_signal_stops_inside_the_step_and_leaves_no_checkpoint(tmp_path, handlers, first, second):
    with pytest.raises(SystemExit):
        train(tmp_path, Sends(2, first, second))
    assert list(tmp_path.iterdir()) == []
    assert present() == handlers


def test_a_whole_training_gives_the_handlers_back(tmp_path, handlers):
    sends = Sends(9)
    _, stop = train(tmp_path, sends)
    assert stop.exit_status == 0
    assert not set(sends.within.values()) & set(handlers.values())
    assert present() == handlers


def test_a_failed_training_gives_the_handlers_back(tmp_path, handlers):
    """Else the Ctrl-C of whatever the process does next would be held back for ever."""
    with pytest.raises(RuntimeError, match="broken"):
        train(tmp_path, Sends(2, exception=RuntimeError("broken")))
    assert present() == handlers


def test_a_torn_stop_is_a_keyboard_interrupt():
    """Lightning shuts down in order for these alone."""
    assert issubclass(TornStop, KeyboardInterrupt)
