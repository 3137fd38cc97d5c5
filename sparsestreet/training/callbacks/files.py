"""Files of a run (checkpoints, the newest one, what is kept), and the signals that end a run in good order.

Signals end training after the step that is under way and its validation, so that it can go on exactly there:
Ctrl-C and SIGTERM, a terminal that closes (SIGHUP), and what clusters send before they take a machine back (SIGUSR1,
SIGUSR2).
"""

import logging
import pickle
import signal
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from jaxtyping import Float64
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

from sparsestreet.atomic import atomic_file, check_regular
from sparsestreet.data.lazy import Sweeps, spread
from sparsestreet.data.log import DrivingLog
from sparsestreet.evaluation.speed import device_name
from sparsestreet.naming import kept_before
from sparsestreet.noise import Calibration, calibrate, noise_between
from sparsestreet.phases import stage
from sparsestreet.ranks import LostProcessError
from sparsestreet.records.curves import CountChange
from sparsestreet.records.run import RIG, RUN, Matrix, RigRecord, RunDescription
from sparsestreet.scene import views
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.intensities import learn_intensities
from sparsestreet.scene.storage import SCENE_FILE, StoredScene, save_scene
from sparsestreet.training.callbacks.density_control import RowListener
from sparsestreet.training.callbacks.times import Clock
from sparsestreet.training.lightning import data_of, ends_step, ranks_of, steps_for, validates_now
from sparsestreet.training.nonfinite import check_parameters
from sparsestreet.training.parallel import DataParallel
from sparsestreet.training.schedule import milestone
from sparsestreet.training.system import StreetSystem

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


LAST, INTERRUPTED = "last.ckpt", "interrupted.ckpt"

_BROKEN = (pickle.UnpicklingError, zipfile.BadZipFile, RuntimeError, EOFError, KeyError, TypeError, ValueError)
"""What reading a broken checkpoint fails with; NotImplementedError, of an unknown way to pack, is a RuntimeError."""


class Checkpoints(Callback):
    """Writes ``last.ckpt`` every ``every`` steps and at the end, ``interrupted.ckpt`` on an exception or a signal.

    ``before`` holds fractions of the run: ``before_0.6.ckpt`` has the last step before what happens after 60 % of it,
    and stays. Runs that differ only from there on can begin with it (``cli/runs/folder.py``).

    Each is written beside its place and renamed: whole or not at all, also on a full disk. Where a periodic one cannot
    be written, training goes on; where the last one cannot, the error is raised. It stands behind the callbacks that
    change rows, so that a checkpoint holds the rows as they left them. It waits for the validation of its step, which
    Lightning would not make up for when the run goes on. (Lightning's ModelCheckpoint has no notion of a plain last
    state without a monitored metric, and its OnExceptionCheckpoint resumes from that file by itself in the next run.)

    What failed inside a step may have moved some parameters and others not: nothing is written then. Numbers that are
    not finite are never written (``training/nonfinite.py``). A checkpoint holds tensors and plain values alone, so that
    opening one runs no code (``weights_only``).
    """

    def __init__(self, folder: str | Path, every: int = 1000, before: Sequence[float] = ()) -> None:
        self.folder = Path(folder)
        self.every = every
        self.before = tuple(before)
        self._due: list[str] = []
        """Names of what is to be written after this step."""
        self._inside = False
        """Whether a step has begun and not ended."""
        self._ready = False
        """Whether all that a checkpoint holds is restored: before, its steps are, and moments may not."""

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        self._inside = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remove what a process left that was killed while it wrote one: its name has the number of that process."""
        self._ready = True
        for half_written in self.folder.glob(".*.tmp.ckpt") if trainer.is_global_zero else ():
            half_written.unlink(missing_ok=True)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        self._inside = False
        self._due = list(self._names(trainer, pl_module)) if ends_step(trainer, batch_idx) else []
        if not validates_now(trainer):
            self._save_due(trainer, pl_module)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.sanity_checking:
            self._save_due(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.interrupted:
            self._save(trainer, pl_module, LAST)
            if trainer.is_global_zero:
                (self.folder / INTERRUPTED).unlink(missing_ok=True)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        # A process that fails by itself has no others to ask for their part of the state.
        alone = ranks_of(trainer).size > 1 and not isinstance(exception, KeyboardInterrupt)
        if alone or self._inside or isinstance(exception, TornStop):
            log.warning("stopped inside step %d: go on from the checkpoint before it", trainer.global_step + 1)
        elif self._ready and trainer.global_step > 0 and self._try_to_save(trainer, pl_module, INTERRUPTED):
            log.warning("stopped after step %d; go on with resume=%s", trainer.global_step, self.folder.parent)

    def _names(self, trainer: Trainer, system: StreetSystem) -> Iterator[str]:
        step = trainer.global_step
        if step % self.every == 0 and step < trainer.max_steps:
            yield LAST
        for fraction in self.before:
            if step == milestone(fraction, system.course) - 1:
                yield kept_before(fraction)

    def _save_due(self, trainer: Trainer, system: LightningModule) -> None:
        for name in self._due:
            self._try_to_save(trainer, system, name)
        self._due = []

    def _try_to_save(self, trainer: Trainer, system: LightningModule, name: str) -> bool:
        try:
            self._save(trainer, system, name)
        except LostProcessError:
            raise  # no matter of the disk: what is in memory is no state to go on from
        except OSError as error:
            log.error("step %d: no checkpoint could be written (%s); the one before it is whole: %s",
                      trainer.global_step, error, self.folder)  # fmt: skip
            return False
        return True

    def _save(self, trainer: Trainer, system: LightningModule, name: str) -> None:
        check_parameters(system.named_parameters(), trainer.global_step)
        for logger in trainer.loggers:
            logger.save()  # else a kill takes the rows of steps that are never taken again
        with stage("save"), atomic_file(self.folder / name) as temporary:
            trainer.save_checkpoint(temporary, weights_only=False)


def step_of(checkpoint: Path) -> int:
    """After how many steps it was written. Raises ValueError for a file that is no checkpoint of plain values, or in
    which a bit is not what was written: torch reads tensors without a look at their checksums."""
    check_regular(checkpoint)
    try:
        _check_sums(checkpoint)
        return int(torch.load(checkpoint, map_location="cpu", weights_only=True)["global_step"])
    except _BROKEN as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{checkpoint} is no checkpoint of a training, is damaged, or holds what may run code, which is never "
            f"opened ({type(error).__name__}: {reason}): go on from another one, or begin again with overwrite=true"
        ) from error


def _check_sums(checkpoint: Path) -> None:
    """Raise ValueError, or what an archive that is broken fails with."""
    with zipfile.ZipFile(checkpoint) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("it is compressed, as no checkpoint is")
        if broken := archive.testzip():
            raise ValueError(f"the checksum of {broken} is wrong")


def newest_checkpoint(run: Path) -> Path:
    """The checkpoint of a run's folder that was written last. Raises FileNotFoundError where there is none."""
    found = list((run / "checkpoints").glob("[!.]*.ckpt"))
    if not found:
        raise FileNotFoundError(f"{run} has no checkpoint to go on from: give the folder of a run that was trained")
    return max(found, key=lambda path: path.stat().st_mtime_ns)


class RunFiles(Callback, RowListener):
    """Writes the scene, ``views.json``, ``rig.json`` and ``run.json`` when training ends, or is interrupted.

    Of several processes only the first writes.

    Args:
        folder: of the run.
        description: what is known of the run before it starts.
        clock: the wall time of training.
    """

    def __init__(self, folder: Path, description: RunDescription, clock: Clock) -> None:
        self.folder = folder
        self.description = description
        self.clock = clock
        self.caps: dict[str, int] = {}
        """Nodes that their limit held down -> the limit."""
        self._limits: dict[str, int | None] = {}
        self._calibration: Calibration | None = None

    def setup(self, trainer: Trainer, pl_module: StreetSystem, stage: str) -> None:
        self._limits = {name: node.settings.max_gaussians for name, node in pl_module.scene.nodes.items()}

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._calibration = calibrate(pl_module.device)

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        limit = self._limits[change.node]
        # A split adds two: one row below the limit there is no room for it either.
        if limit is not None and change.after > change.before and change.after >= limit - 1:
            self.caps[change.node] = limit

    def on_train_end(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if not trainer.interrupted:
            with stage("intensities"):
                _learn_intensities(trainer, pl_module)
            self.write(trainer, pl_module)

    def on_exception(self, trainer: Trainer, pl_module: StreetSystem, exception: BaseException) -> None:
        started = self._calibration is not None  # else steps are restored, and what they made may not be
        if started and trainer.global_step > 0 and not isinstance(exception, TornStop | OSError):
            self.write(trainer, pl_module)

    def write(self, trainer: Trainer, system: StreetSystem) -> None:
        """Leave the files as training stands now."""
        if not trainer.is_global_zero:
            return
        system.settle()
        before = self._calibration
        description = replace(
            self.description,
            device=device_name(system.device),
            threads=torch.get_num_threads(),
            steps=trainer.global_step,
            max_steps=system.course.steps if system.course.changed else steps_for(trainer, self.description.max_steps),
            training_seconds=self.clock.seconds,
            noise=None if before is None else noise_between(before, calibrate(system.device)),
            caps=dict(self.caps),
            held_back=dict(system.held_back),
            rested=dict(system.quarantine.counts),
        )
        data = data_of(trainer)
        log, split = data.driving_log, data.split
        stored = StoredScene(system.scene, system.options, log.name, log.num_frames)
        with stage("save"):
            save_scene(self.folder / SCENE_FILE, stored)
            views.write_views(
                self.folder / views.VIEWS_FILE, split.train.views, split.held_out.views, frame_rate=log.frame_rate
            )
            RIG.write(self.folder, _rig(log))
            RUN.write(self.folder, description)

    def state_dict(self) -> dict[str, Any]:
        return {"caps": self.caps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.caps = dict(state_dict["caps"])


MAX_SWEEPS = 60
"""Of whose returns intensities are learned, spread over the log; on a processor each takes a tenth of a second."""


def _learn_intensities(trainer: Trainer, system: StreetSystem) -> None:
    """Where the log has any: of sweeps that no instant held out has."""
    if not trainer.is_global_zero:
        return
    data = data_of(trainer)
    held_out, sweeps = data.split.held_out_indices, data.driving_log.sweeps
    known = [place for place, index in enumerate(sweeps.indices) if index not in held_out]
    sweeps = sweeps.at(known[at] for at in spread(len(known), MAX_SWEEPS))
    returns = (
        (sweep, values)
        for sweep in sweeps.gray()
        if sweep.origin is not None and (values := sweeps.load_intensities(sweep.index)) is not None
    )
    if met := learn_intensities(system.scene, returns, system.options):
        log.info("intensities: returns met %d of %d Gaussians", met, sum(system.scene.counts().values()))


def _rig(log: DrivingLog) -> RigRecord:
    vehicle = log.vehicle
    return RigRecord(
        camera_names=log.camera_names,
        dataset_from_world=_matrix(log.dataset_from_world),
        world_from_vehicle=None if vehicle is None else tuple(_matrix(pose) for pose in vehicle.poses),
        vehicle_stamps=None if vehicle is None else vehicle.stamps,
        lidar=_lidar_place(log.sweeps),
    )


def _lidar_place(sweeps: Sweeps) -> tuple[float, ...] | None:
    """Return where the lidar of the sweep in the middle stood, and when."""
    middle = next(sweeps.at([len(sweeps) // 2]).gray(), None) if len(sweeps) else None
    return None if middle is None or middle.origin is None else (*middle.origin.tolist(), middle.time)


def _matrix(pose: Float64[Tensor, "4 4"]) -> Matrix:
    return tuple(tuple(row) for row in pose.tolist())
