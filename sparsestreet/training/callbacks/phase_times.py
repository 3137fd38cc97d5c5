"""Where the steps of a run spend their time, noted now and then."""

from dataclasses import astuple
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from sparsestreet.phases import PhaseRecorder, clock_of
from sparsestreet.records.costs import STEP_PHASES, StepPhase
from sparsestreet.training.lightning import ends_step

LOOP = "loop"
"""What is in no phase: Lightning, and callbacks that have nothing to do in a step."""


class PhaseTimes(Callback):
    """Writes ``phases.csv`` when training ends, or is interrupted: step, phase, milliseconds.

    A step counts from the end of the one before it to its own. Most steps are not looked at and pay nothing; one that
    is costs some tens of microseconds more.
    """

    def __init__(self, path: str | Path, every: int = 47) -> None:
        """``every``: steps from one that is looked at to the next."""
        if every < 1:
            raise ValueError(f"phases are noted every so many steps, at least 1, got {every}")
        self.path = Path(path)
        self.every = every
        self.rows: list[StepPhase] = []
        self._recorder: PhaseRecorder | None = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        step = trainer.global_step
        self._note(step)
        if (step + 1) % self.every == 0:
            self._recorder = PhaseRecorder(clock_of(pl_module.device), outside=LOOP)
            self._recorder.start()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._forget()
        self._write(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._forget()
        if self.rows and not isinstance(exception, OSError):
            self._write(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # It would be counted as a part of the step that follows it.
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        return {"rows": [astuple(row) for row in self.rows]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = [StepPhase(*row) for row in state_dict["rows"]]

    def _note(self, step: int) -> None:
        if self._recorder is not None:
            self.rows += [StepPhase(step, name, 1e3 * seconds) for name, seconds in self._recorder.stop().items()]
            self._recorder = None

    def _forget(self) -> None:
        if self._recorder is not None:
            self._recorder.stop()
            self._recorder = None

    def _write(self, trainer: Trainer) -> None:
        if trainer.is_global_zero:
            STEP_PHASES.write_to(self.path, self.rows)
