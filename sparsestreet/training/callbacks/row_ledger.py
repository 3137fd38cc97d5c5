"""Keeps the count of Gaussians per node over the steps, with the reason of each change."""

from dataclasses import astuple
from pathlib import Path
from typing import Any

from lightning import Callback, Trainer

from sparsestreet.records.curves import LEDGER, CountChange
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.callbacks.resizing import RowListener
from sparsestreet.training.system import StreetSystem


class RowLedger(Callback, RowListener):
    """Collects row changes and writes them as ``counts.csv`` when training ends, or is interrupted."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.changes: list[CountChange] = []

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        if change.after != change.before:
            self.changes.append(change)

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if not self.changes:
            self.changes += [CountChange(0, node, 0, rows, "start") for node, rows in pl_module.scene.counts().items()]

    def on_train_end(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._write(trainer)

    def on_exception(self, trainer: Trainer, pl_module: StreetSystem, exception: BaseException) -> None:
        # Training that failed before its start has nothing to say, and a full disk would hide what failed.
        if self.changes and not isinstance(exception, OSError):
            self._write(trainer)

    def state_dict(self) -> dict[str, Any]:
        return {"changes": [astuple(change) for change in self.changes]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.changes = [CountChange(*change) for change in state_dict["changes"]]

    def _write(self, trainer: Trainer) -> None:
        if trainer.is_global_zero:
            LEDGER.write_to(self.path, self.changes)
