"""Signals end training after the step that is under way and its validation, so that it can go on exactly there.

Ctrl-C and SIGTERM, a terminal that closes (SIGHUP), and what clusters send before they take a machine back (SIGUSR1,
SIGUSR2).
"""

import logging
import signal
from types import FrameType

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from sparsestreet.training.lightning import ends_step, validates_now
from sparsestreet.training.parallel import DataParallel

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


class TornStop(KeyboardInterrupt):
    """Ctrl-C behind another signal stopped training inside a step: what is in memory is no state to go on from."""


class GracefulStop(Callback):
    """Holds a signal back until the step is done, then raises KeyboardInterrupt; Ctrl-C behind it stops at once.

    An optimizer that is interrupted has moved some parameters and others not. Configure it last: checkpoints and row
    changes of the step come first. A signal that the process ignores (``nohup``) stays ignored, and those behind the
    first ask for nothing new: clusters send several.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        """Number of the signal that ended training; None: none did."""
        self._stops = False
        """Whether training ends with this step, once it has validated where it is due."""

    @property
    def exit_status(self) -> int:
        """What a shell expects of a program that the signal ended; 0 where none did."""
        return 0 if self.received is None else 128 + self.received

    def hand_on(self) -> None:
        """Give the signal to whoever handled it before training, once the checkpoint is written: submitit requeues."""
        if self.received is None:
            return
        handler = signal.getsignal(self.received)
        if callable(handler) and handler is not signal.default_int_handler:
            handler(self.received, None)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # Not earlier: after on_fit_start Lightning notes which handlers it finds, and puts these back however it ends.
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._receive)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        self._stops = ends_step(trainer, batch_idx) and self._agreed(trainer)
        if self._stops and not validates_now(trainer):
            raise KeyboardInterrupt

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._stops and not trainer.sanity_checking:
            raise KeyboardInterrupt

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self.received is None:
            # A signal before training started came as one of these.
            kinds = ((KeyboardInterrupt, signal.SIGINT), (SIGTERMException, signal.SIGTERM))
            self.received = next((number for kind, number in kinds if isinstance(exception, kind)), None)

    def _agreed(self, trainer: Trainer) -> bool:
        """Whether a signal came; of several processes all stop after the same step, whichever of them heard of it."""
        strategy = trainer.strategy
        if isinstance(strategy, DataParallel):
            self.received, strategy.wish = strategy.agreed or self.received, self.received or 0
            return bool(strategy.agreed)
        return self.received is not None

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is None:
            self.received = number
            log.warning("stopping after this step; Ctrl-C from now on stops at once, without a checkpoint")
        elif number == signal.SIGINT:
            raise TornStop
