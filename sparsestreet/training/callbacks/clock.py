"""Wall time of training, validation left out."""

import time
from typing import Any

from lightning import Callback, LightningModule, Trainer


class Clock(Callback):
    """``seconds`` grows while training runs; it survives a resume."""

    def __init__(self) -> None:
        self._finished = 0.0
        self._started: float | None = None
        self._interrupted = False

    @property
    def seconds(self) -> float:
        running = 0.0 if self._started is None else time.perf_counter() - self._started
        return self._finished + running

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._started = time.perf_counter()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._pause()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._interrupted = self._started is not None
        self._pause()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # Lightning also validates before training starts, and whoever wants to after its end.
        if self._interrupted:
            self._started = time.perf_counter()

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._finished = state_dict["seconds"]

    def _pause(self) -> None:
        self._finished, self._started = self.seconds, None
