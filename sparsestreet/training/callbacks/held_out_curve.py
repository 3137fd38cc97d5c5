"""How good held-out views got after how many seconds of training."""

from dataclasses import astuple
from pathlib import Path
from typing import Any

from lightning import Callback, LightningModule, Trainer

from sparsestreet.records.curves import HELD_OUT_CURVE, HeldOutLook
from sparsestreet.training.callbacks.clock import Clock

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
