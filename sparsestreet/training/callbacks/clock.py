"""Training time without validation, and the rate of steps."""

import time

from lightning import Callback, LightningModule, Trainer


class Clock(Callback):
    """``seconds`` is wall time spent in training; it survives a resume."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._started: float | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._started = time.perf_counter()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._stop()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.training or trainer.fit_loop.epoch_loop.global_step > 0:
            self._started = time.perf_counter()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._stop()

    def state_dict(self) -> dict[str, object]:
        running = time.perf_counter() - self._started if self._started is not None else 0.0
        return {"seconds": self.seconds + running}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.seconds = state_dict["seconds"]

    def _stop(self) -> None:
        if self._started is not None:
            self.seconds += time.perf_counter() - self._started
            self._started = None
