"""A signal ends training after the step that is under way; the process has its own handlers back afterwards."""

import signal
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer

from sparsestreet.training.callbacks import Checkpoints, GracefulStop
from sparsestreet.training.callbacks.files import SIGNALS
from tests.training.stubs import background, fit, frame_at, make_system

STEPS = 4


@pytest.fixture(autouse=True)
def handlers() -> Iterator[dict[int, Any]]:
    """Those of the process, put back whatever a test leaves."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    # A shell starts its background jobs with SIGINT ignored, nohup with SIGHUP, and Python then leaves them so.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
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


def train(folder: Any, sends: Sends, stop: GracefulStop | None = None) -> GracefulStop:
    """A training of four steps with the callbacks as a run orders them."""
    stop = stop or GracefulStop()
    system = make_system({"background": background(5)}, sh_interval=1.0)  # else some columns start late
    fit(system, [sends, Checkpoints(folder), stop], STEPS, frame_at())
    return stop


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGUSR1, 138), (signal.SIGUSR2, 140)],
)
def test_a_signal_ends_training_after_its_step(tmp_path, handlers, number, status):
    with pytest.raises(SystemExit):
        train(tmp_path, Sends(2, number), stop := GracefulStop())
    assert stop.exit_status == status
    saved = torch.load(tmp_path / "interrupted.ckpt", weights_only=False)
    assert saved["global_step"] == 2
    state = saved["optimizer_states"][0]["state"]
    assert {float(moments["step"]) for moments in state.values()} == {2.0}  # the whole of the second step
    assert not (tmp_path / "last.ckpt").exists()
    assert present() == handlers


def test_what_clusters_send_behind_the_first_asks_for_nothing_new(tmp_path):
    with pytest.raises(SystemExit):
        train(tmp_path, Sends(2, signal.SIGUSR2, signal.SIGTERM, signal.SIGUSR2), stop := GracefulStop())
    assert stop.exit_status == 140
    assert torch.load(tmp_path / "interrupted.ckpt", weights_only=False)["global_step"] == 2


def test_an_ignored_signal_stays_ignored(tmp_path):
    """Of a run that nohup started, when its terminal closes."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert train(tmp_path, Sends(2, signal.SIGHUP)).exit_status == 0


def test_a_signal_is_handed_on_to_whoever_waited_for_it(tmp_path):
    """After the checkpoint is written; submitit requeues its job then."""
    seen: list[tuple[int, bool]] = []
    signal.signal(signal.SIGUSR2, lambda number, frame: seen.append((number, (tmp_path / "interrupted.ckpt").exists())))
    with pytest.raises(SystemExit):
        train(tmp_path, Sends(2, signal.SIGUSR2), stop := GracefulStop())
    assert seen == []
    stop.hand_on()
    assert seen == [(signal.SIGUSR2, True)]


@pytest.mark.parametrize("number", [None, signal.SIGINT, signal.SIGTERM])
def test_there_may_be_nobody_to_hand_it_on_to(number):
    """Python's own answer to Ctrl-C is no answer to one that was heeded, and the system's would end the process."""
    stop = GracefulStop()
    stop.received = number
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    stop.hand_on()


class Validated(Callback):
    """At which steps validation ended."""

    def __init__(self) -> None:
        self.steps: list[int] = []

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if not trainer.sanity_checking:
            self.steps.append(trainer.global_step)


@pytest.mark.parametrize("every", [1, 2])
def test_a_stop_and_a_checkpoint_wait_for_the_validation_of_their_step(tmp_path, every):
    """Lightning makes up for none when training goes on; what was counted, and what stood in its state."""
    seen, stop, kept = Validated(), GracefulStop(), []

    class Keeps(Checkpoints):
        def _save(self, trainer: Trainer, system: Any, name: str) -> None:
            kept.append((name, trainer.global_step, list(seen.steps)))
            super()._save(trainer, system, name)

    system = make_system({"background": background(5)})
    validated = {"limit_val_batches": 1, "val_check_interval": 2, "check_val_every_n_epoch": None}
    with pytest.raises(SystemExit):
        fit(system, [seen, Sends(4, signal.SIGTERM), Keeps(tmp_path, every), stop], 6, frame_at(), **validated)
    assert seen.steps == [2, 4]
    periodic = [("last.ckpt", 1, []), ("last.ckpt", 2, [2]), ("last.ckpt", 3, [2]), ("last.ckpt", 4, [2, 4])]
    assert kept[:-1] == [one for one in periodic if one[1] % every == 0]
    assert kept[-1] == ("interrupted.ckpt", 4, [2, 4])


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
    assert train(tmp_path, sends).exit_status == 0
    assert not set(sends.within.values()) & set(handlers.values())
    assert present() == handlers


def test_a_failed_training_gives_the_handlers_back(tmp_path, handlers):
    """Else the Ctrl-C of whatever the process does next would be held back for ever."""
    with pytest.raises(RuntimeError, match="broken"):
        train(tmp_path, Sends(2, exception=RuntimeError("broken")))
    assert present() == handlers
