"""Keeps the count of Gaussians per node over the steps, with the reason of each change."""

import csv
from dataclasses import astuple, fields
from pathlib import Path

from lightning import Callback, LightningModule, Trainer

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.callbacks.resizing import RowChange, RowListener


class RowLedger(Callback, RowListener):
    """Collects row changes and writes them as ``counts.csv`` when training ends (or is interrupted)."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.changes: list[RowChange] = []

    def on_rows_changed(self, change: RowChange, plan: RowPlan) -> None:
        if change.after != change.before:
            self.changes.append(change)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not self.changes:
            self.changes += [RowChange(0, node, 0, rows, "start") for node, rows in pl_module.scene.counts().items()]

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage != "fit" or not trainer.is_global_zero:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow([field.name for field in fields(RowChange)])
            writer.writerows(astuple(change) for change in self.changes)

    def state_dict(self) -> dict[str, object]:
        return {"changes": [astuple(change) for change in self.changes]}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.changes = [RowChange(*change) for change in state_dict["changes"]]
