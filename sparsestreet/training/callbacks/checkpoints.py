"""What training leaves to go on from: a checkpoint now and then, at the end, and when it is interrupted."""

import logging
from pathlib import Path

from lightning import Callback, LightningModule, Trainer

log = logging.getLogger(__name__)


class Checkpoints(Callback):
    """Writes ``last.ckpt`` every ``every`` steps and at the end, ``interrupted.ckpt`` on an exception or Ctrl-C.

    Configure it last, so that a checkpoint holds the rows as the other callbacks left them. (Lightning's
    ModelCheckpoint has no notion of a plain last state without a monitored metric, and its OnExceptionCheckpoint
    resumes from that file by itself in the next run.)
    """

    def __init__(self, folder: str | Path, every: int = 1000) -> None:
        self.folder = Path(folder)
        self.every = every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if trainer.global_step % self.every == 0 and trainer.global_step < trainer.max_steps:
            trainer.save_checkpoint(self.folder / "last.ckpt", weights_only=False)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.interrupted:
            trainer.save_checkpoint(self.folder / "last.ckpt", weights_only=False)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if trainer.global_step > 0:
            path = self.folder / "interrupted.ckpt"
            trainer.save_checkpoint(path, weights_only=False)
            log.warning("stopped at step %d; go on with resume=%s", trainer.global_step, path)
