"""How good held-out views got after how many seconds of training."""

import csv
import io
from pathlib import Path

from lightning import Callback, LightningModule, Trainer

from sparsestreet.atomic import atomic_file
from sparsestreet.training.callbacks.clock import Clock

COLUMNS = {"psnr_full": "val/psnr", "psnr_human": "val/psnr_human", "psnr_vehicle": "val/psnr_vehicle"}
"""Column of the file -> what validation logs."""


class HeldOutCurve(Callback):
    """Writes ``held_out.csv`` after each validation: seconds, step, and PSNR in dB by region, all pixels, people and
    vehicles; a cell stays blank where no view has the mask.

    The views are those of ``split.val_frames``, the same each time. Seconds are those of the clock: training alone,
    over all commands of a run that was interrupted.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.path = path
        self.clock = clock
        self.rows: list[tuple[float | int | None, ...]] = []

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking:
            return
        logged = trainer.callback_metrics
        values = (float(logged[name]) if name in logged else None for name in COLUMNS.values())
        self.rows.append((self.clock.seconds, trainer.global_step, *values))
        if trainer.is_global_zero:
            self._write()

    def state_dict(self) -> dict[str, object]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.rows = list(state_dict["rows"])

    def _write(self) -> None:
        buffer = io.StringIO()
        writer = csv.writer(buffer, lineterminator="\n")
        writer.writerow(("seconds", "step", *COLUMNS))
        for seconds, step, *values in self.rows:
            writer.writerow((f"{seconds:.3f}", step, *("" if value is None else f"{value:.4f}" for value in values)))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(self.path) as temporary:
            temporary.write_text(buffer.getvalue())
