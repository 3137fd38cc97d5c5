"""One bar over the whole run: steps a second, Gaussians, PSNR. Where no terminal listens, a line per tenth."""

import logging
import time

from lightning import Callback, Trainer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sparsestreet.training.lightning import ends_step
from sparsestreet.training.schedule import ROUNDING, Course
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

REFRESH_EVERY = 10
LINES = 10


class TrainingProgress(Callback):
    """Shows the step rate (of the last ``REFRESH_EVERY`` steps), counts per node and running PSNR; of several processes
    the first does."""

    def __init__(self) -> None:
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._since = (0, 0.0)
        self._held_out: tuple[float | None, int] = None, 0
        """PSNR, dB, and the step that it was measured at; None until it was."""

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._since = (trainer.global_step, time.perf_counter())
        console = Console()
        if console.is_terminal and trainer.is_global_zero:
            columns = (BarColumn(20), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
            self._bar = Progress(*columns, console=console)
            self._task = self._bar.add_task("", total=trainer.max_steps, completed=trainer.global_step)
            self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step = trainer.global_step
        if not (trainer.is_global_zero and ends_step(trainer, batch_idx)) or not self._due(step, pl_module.course):
            return
        text = self._status(trainer, pl_module)
        if self._bar is not None:
            self._bar.update(self._task, completed=step, total=trainer.max_steps, description=text)
        else:
            log.info("step %d of %d: %s", step, trainer.max_steps, text)

    def on_validation_end(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        # Read once, since reading waits for a GPU.
        psnr = trainer.callback_metrics.get("val/psnr")
        self._held_out = None if psnr is None else float(psnr), trainer.global_step

    def teardown(self, trainer: Trainer, pl_module: StreetSystem, stage: str) -> None:
        self._stop()

    def on_exception(self, trainer: Trainer, pl_module: StreetSystem, exception: BaseException) -> None:
        # Lightning tears no callback down then, and a live bar hides the cursor.
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _due(self, step: int, course: Course) -> bool:
        if self._bar is not None:
            return step % REFRESH_EVERY == 0 or step == course.steps
        # Where another tenth is full.
        return last_part(course.progress(step)) > last_part(course.progress(step - 1))

    def _status(self, trainer: Trainer, system: StreetSystem) -> str:
        first, then = self._since
        now = time.perf_counter()
        self._since = (trainer.global_step, now)
        parts = [f"{(trainer.global_step - first) / max(now - then, 1e-9):.1f} steps/s"]
        train, (held_out, looked) = system.said.newest.get("psnr"), self._held_out
        parts += [] if train is None else [f"train {train:.2f} dB"]
        # Of an earlier step, it would read as that of a model that fits its training views alone.
        of = "" if looked == trainer.global_step else f" (step {looked})"
        parts += [] if held_out is None else [f"held out {held_out:.2f} dB{of}"]
        parts += [f"{name} {rows:,}" for name, rows in system.scene.counts().items()]
        return ", ".join(parts)


def last_part(progress: float) -> int:
    """Which of the run's ``LINES`` parts is done."""
    return int(progress * LINES + ROUNDING)
