"""Callbacks that count: seconds of stages and phases, rows of each node, looks at held-out views."""

import time
from dataclasses import astuple
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from sparsestreet.phases import PhaseRecorder, StageRecorder, clock_of
from sparsestreet.records.costs import STEP_PHASES, StepPhase
from sparsestreet.records.curves import HELD_OUT_CURVE, LEDGER, CountChange, HeldOutLook
from sparsestreet.records.file import CsvFile
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.callbacks.density_control import RowListener
from sparsestreet.training.lightning import ends_step
from sparsestreet.training.system import StreetSystem


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


class StageTimes(Callback):
    """Takes validation out of training, and hands the seconds to the command that goes on with the run."""

    def __init__(self, recorder: StageRecorder) -> None:
        self.recorder = recorder

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.recorder.enter("validate")

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.recorder.leave()

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.recorder.seconds()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.recorder.go_on(state_dict["seconds"])


class _Table(Callback):
    """Rows that are written when training ends, or is interrupted; a checkpoint keeps them."""

    file: CsvFile[Any]
    kind: type[Any]
    """Of a row."""
    key = "rows"
    """What a checkpoint calls them."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.rows: list[Any] = []

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._write(trainer)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        # Training that failed before its start has nothing to say, and a full disk would hide what failed.
        if self.rows and not isinstance(exception, OSError):
            self._write(trainer)

    def state_dict(self) -> dict[str, Any]:
        return {self.key: [astuple(row) for row in self.rows]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = [self.kind(*row) for row in state_dict[self.key]]

    def _write(self, trainer: Trainer) -> None:
        if trainer.is_global_zero:
            self.file.write_to(self.path, self.rows)


LOOP = "loop"
"""What is in no phase: Lightning, and callbacks that have nothing to do in a step."""


class PhaseTimes(_Table):
    """Writes ``phases.csv`` when training ends, or is interrupted: step, phase, milliseconds.

    A step counts from the end of the one before it to its own. Most steps are not looked at and pay nothing; one that
    is costs some tens of microseconds more.
    """

    file, kind = STEP_PHASES, StepPhase

    def __init__(self, path: str | Path, every: int = 47) -> None:
        """``every``: steps from one that is looked at to the next."""
        super().__init__(path)
        if every < 1:
            raise ValueError(f"phases are noted every so many steps, at least 1, got {every}")
        self.every = every
        self._recorder: PhaseRecorder | None = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        step = trainer.global_step
        self.rows += [StepPhase(step, name, 1e3 * seconds) for name, seconds in self._stop().items()]
        if (step + 1) % self.every == 0:
            self._recorder = PhaseRecorder(clock_of(pl_module.device), outside=LOOP)
            self._recorder.start()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._stop()
        super().on_train_end(trainer, pl_module)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._stop()
        super().on_exception(trainer, pl_module, exception)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # It would be counted as a part of the step that follows it.
        self._stop()

    def _stop(self) -> dict[str, float]:
        recorder, self._recorder = self._recorder, None
        return {} if recorder is None else recorder.stop()


class RowLedger(_Table, RowListener):
    """Collects row changes and writes them as ``counts.csv`` when training ends, or is interrupted."""

    file, kind, key = LEDGER, CountChange, "changes"

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        if change.after != change.before:
            self.rows.append(change)

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if not self.rows:
            self.rows += [CountChange(0, node, 0, rows, "start") for node, rows in pl_module.scene.counts().items()]


COLUMNS = {"psnr_full": "val/psnr", "psnr_human": "val/psnr_human", "psnr_vehicle": "val/psnr_vehicle"}
"""Field of a look -> what validation logs."""


class HeldOutCurve(Callback):
    """Writes ``curves/held_out.csv`` after each validation.

    The views are those of ``split.val_frames``, the same each time. Seconds are those of the clock: training alone,
    over all commands of a run that was interrupted.
    """

    def __init__(self, run: Path, clock: Clock) -> None:
        """``run``: the run's folder."""
        self.run = run
        self.clock = clock
        self.looks: list[HeldOutLook] = []

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking:
            return
        logged = trainer.callback_metrics
        psnr = {column: float(logged[name]) if name in logged else None for column, name in COLUMNS.items()}
        self.looks.append(HeldOutLook(self.clock.seconds, trainer.global_step, **psnr))
        if trainer.is_global_zero:
            HELD_OUT_CURVE.write(self.run, self.looks)

    def state_dict(self) -> dict[str, Any]:
        return {"rows": [astuple(look) for look in self.looks]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.looks = [HeldOutLook(*row) for row in state_dict["rows"]]
