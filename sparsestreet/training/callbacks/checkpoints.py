"""What training leaves to go on from: a checkpoint now and then, at chosen moments, at the end, when interrupted."""

import logging
import pickle
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from lightning import Callback, LightningModule, Trainer

from sparsestreet.atomic import atomic_file, check_regular
from sparsestreet.naming import kept_before
from sparsestreet.phases import stage
from sparsestreet.ranks import LostProcessError
from sparsestreet.training.callbacks.graceful_stop import TornStop
from sparsestreet.training.finite import check_parameters
from sparsestreet.training.lightning import ends_step, ranks_of, validates_now
from sparsestreet.training.schedule import milestone
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

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
    not finite are never written (``training/finite.py``). A checkpoint holds tensors and plain values alone, so that
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

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        self._inside = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remove what a process left that was killed while it wrote one: its name has the number of that process."""
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
        elif trainer.global_step > 0 and self._try_to_save(trainer, pl_module, INTERRUPTED):
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
    """Raises ValueError, or what an archive that is broken fails with."""
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
