"""Ctrl-C and SIGTERM end training after the step that is under way, so that it can go on exactly there."""

import logging
import signal
from types import FrameType

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException

from sparsestreet.training.lightning import ends_step
from sparsestreet.training.parallel import DataParallel

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class TornStop(KeyboardInterrupt):
    """A second signal stopped training inside a step: what is in memory is no state to go on from."""


class GracefulStop(Callback):
    """Holds a signal back until the step is done, then raises KeyboardInterrupt; a second one stops at once.

    An optimizer that is interrupted has moved some parameters and others not. Configure it last: checkpoints and row
    changes of the step come first.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        """Number of the signal that ended training; None: none did."""

    @property
    def exit_status(self) -> int:
        """What a shell expects of a program that the signal ended; 0 where none did."""
        return 0 if self.received is None else 128 + self.received

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # Not earlier: after on_fit_start Lightning notes which handlers it finds, and puts these back however it ends.
        for number in SIGNALS:
            signal.signal(number, self._receive)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        strategy = trainer.strategy
        if isinstance(strategy, DataParallel):
            # All processes stop after the same step, whichever of them heard of it.
            self.received, strategy.wish = strategy.agreed or self.received, self.received or 0
            if not strategy.agreed:
                return
        if self.received is not None:
            raise KeyboardInterrupt

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if self.received is None:
            # A signal before training started came as one of these.
            kinds = ((KeyboardInterrupt, signal.SIGINT), (SIGTERMException, signal.SIGTERM))
            self.received = next((number for kind, number in kinds if isinstance(exception, kind)), None)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise TornStop
        self.received = number
        log.warning("stopping after this step; once more stops at once, without a checkpoint")
