"""An interrupted or failed training leaves a checkpoint to go on from."""

from pathlib import Path

from lightning import Callback, LightningModule, Trainer


class SaveOnException(Callback):
    """Writes ``path`` when training is interrupted or raises.

    (Lightning's own OnExceptionCheckpoint also resumes from that file by itself in the next run: a surprise.)
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if trainer.global_step > 0:
            trainer.save_checkpoint(self.path)
