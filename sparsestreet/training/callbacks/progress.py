"""One bar over the whole run: steps a second, Gaussians, PSNR. Where no terminal listens, a line per tenth."""

import logging
import time
from typing import Any

from lightning import Callback, Trainer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sparsestreet.evaluation.speed import Timing
from sparsestreet.phases import StageRecorder
from sparsestreet.training.callbacks.density_control import DensityControl
from sparsestreet.training.callbacks.sparsify import Pruning
from sparsestreet.training.forecast import (
    Forecast,
    growth_of,
    measured_evaluation,
    measured_step,
    renders_of,
    report_memory,
    size_in_words,
)
from sparsestreet.training.lightning import (
    callbacks_of,
    data_of,
    end_after,
    ends_step,
    images_per_step,
    is_dev_run,
)
from sparsestreet.training.schedule import ROUNDING, Course, milestone
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


LOOKS = 40
"""A budget looks at the clock each time that another such part of the run is done."""


class Pace(Callback):
    """Says before the first step how many steps, Gaussians and minutes a run has before it, and how it knows.

    With ``minutes`` the run ends in time: the number of steps follows from what a step takes, by the forecast first
    and then by the clock, and the schedule follows the number of steps (``Course``). Such a run depends on the speed
    of its machine, so it cannot be repeated to the bit.

    Args:
        stages: what the command has spent until now.
        minutes: for the whole command up to its records, without extra metrics; None: no limit.
        timing: how often evaluation will render.
    """

    def __init__(self, stages: StageRecorder, minutes: float | None = None, timing: Timing | None = None) -> None:
        if minutes is not None and not minutes > 0:
            raise ValueError(f"a budget needs more than 0 minutes, got {minutes}")
        self.stages, self.minutes, self.timing = stages, minutes, timing or Timing()
        self._course: dict[str, Any] | None = None
        self._step = 0.0
        self._seen = (0, 0.0)

    def on_fit_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if self._course is not None:  # of a checkpoint
            pl_module.course.load_state_dict(self._course)
            end_after(trainer, pl_module.course.steps)

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if is_dev_run(trainer) or not len(data_of(trainer).split.train):
            return
        report_memory(pl_module, data_of(trainer))
        self._step = measured_step(pl_module, data_of(trainer)) * trainer.accumulate_grad_batches
        forecast = self._forecast(trainer, pl_module)
        if self.minutes is not None:
            self._fit(trainer, pl_module, forecast)
        steps, step = pl_module.course.steps, trainer.global_step
        left = forecast.training(steps - step, pl_module.course.progress(step)) + self._passes(trainer, pl_module)
        log.info(
            "%s steps, %s, about %.1f minutes and %.1f for evaluation: a step takes %.0f ms now, as "
            "a few show, and %.0f ms with all Gaussians",
            f"{steps:,}", size_in_words(pl_module), left / 60, forecast.evaluation / 60,
            1e3 * forecast.step, 1e3 * forecast.step * forecast.growth,
        )  # fmt: skip
        self._seen = (step, self._seconds("train"))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        step, course = trainer.global_step, pl_module.course
        before, seconds = self._seen
        if (
            self.minutes is None
            or step + 1 >= course.steps
            or course.progress(step) < course.progress(before) + 1 / LOOKS
        ):
            return
        self._step = (self._seconds("train") - seconds) / (step - before) + self._seconds("validate") / step
        self._fit(trainer, pl_module, self._forecast(trainer, pl_module))
        self._seen = (step, self._seconds("train"))

    def _fit(self, trainer: Trainer, system: StreetSystem, forecast: Forecast) -> None:
        """As many steps as the time that is left allows, and two at least."""
        assert self.minutes is not None  # there is no other caller
        left = 60 * self.minutes - self._seconds() - forecast.evaluation - self._passes(trainer, system)
        step = trainer.global_step
        steps = step + max(forecast.steps(left, system.course.progress(step)), 2)
        steps = trainer.strategy.broadcast(steps)  # clocks of several processes differ
        system.course.change(step, steps)
        end_after(trainer, steps)
        self._course = system.course.state_dict()

    def _forecast(self, trainer: Trainer, system: StreetSystem) -> Forecast:
        data = data_of(trainer)
        image, frame = measured_evaluation(system, data)
        cameras = len({view.camera_index for view in data.split.train.views})
        until = [one.densify_until for one in callbacks_of(trainer) if isinstance(one, DensityControl)]
        return Forecast(
            step=self._step,
            growth=growth_of(system),
            grown=max(until, default=0.0),
            image=image,
            frame=frame,
            images=len(data.split.train) + len(data.split.held_out),
            renders=renders_of(self.timing, cameras, len(system.scene.nodes) + len(system.scene.effects)),
        )

    def _passes(self, trainer: Trainer, system: StreetSystem) -> float:
        """Seconds of the pruning passes that are to come: each looks at all training views, once."""
        moments = [
            milestone(fraction, system.course)
            for one in callbacks_of(trainer) if isinstance(one, Pruning) for fraction in one.at
        ]  # fmt: skip
        left = sum(moment > trainer.global_step for moment in moments)
        done = len(moments) - left
        views = len(data_of(trainer).split.train) / images_per_step(trainer)
        of_one = self._seconds("prune") / done if done else views * self._step
        return left * of_one

    def _seconds(self, stage: str = "") -> float:
        """That the command has spent: in all, or in one stage and its parts."""
        return sum(spent for name, spent in self.stages.seconds().items() if name.startswith(stage))

    def state_dict(self) -> dict[str, Any]:
        return {"course": self._course}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._course = state_dict["course"]
