"""Ctrl-C and SIGTERM end training after the step that is under way, so that it can go on exactly there."""

import logging
import signal
from types import FrameType
from typing import Any

from lightning import Callback, LightningModule, Trainer

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
        self._before: dict[int, Any] = {}

    @property
    def exit_status(self) -> int:
        """What a shell expects of a program that the signal ended; 0 where none did."""
        return 0 if self.received is None else 128 + self.received

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # After Lightning's own handlers, which end a process on SIGTERM with status 0.
        for number in SIGNALS:
            self._before[number] = signal.signal(number, self._receive)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if self.received is not None:
            raise KeyboardInterrupt

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        # Lightning tears no callback down after an exception.
        self._release()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._release()

    def _release(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise TornStop
        self.received = number
        log.warning("stopping after this step; once more stops at once, without a checkpoint")
