"""The one way in which callbacks change a node's rows and columns during training."""

import logging

from lightning import Trainer

from sparsestreet.records.curves import CountChange
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.lightning import callbacks_of, ranks_of
from sparsestreet.training.parallel.agreement import check_agreement
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)


class RowListener:
    """A callback that keeps something for every row; it hears of each change."""

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        raise NotImplementedError


def resize_rows(trainer: Trainer, system: StreetSystem, node: str, plan: RowPlan, reason: str) -> None:
    """Apply a plan to a node's rows and the optimizer, drop the stale graph, and tell every listener."""
    rows = system.scene.nodes[node].rows
    before = len(rows)
    rows.resize(plan, trainer.optimizers[0])
    system.rendering = None
    change = CountChange(trainer.global_step, node, before, len(rows), reason)
    for callback in callbacks_of(trainer):
        if isinstance(callback, RowListener):
            callback.on_rows_changed(change, plan)
    log.debug("step %d: %s %s, %d -> %d rows", change.step, node, reason, before, change.after)


def compare_rows(trainer: Trainer, system: StreetSystem) -> None:
    """After a change of rows: see that all processes made the same one. Raises DisagreementError."""
    check_agreement(system.scene, ranks_of(trainer))


def end_mask(trainer: Trainer, system: StreetSystem, node: str) -> None:
    """Finish a node's mask, and take what it learned out of the optimizer."""
    system.scene.nodes[node].finish_mask(trainer.optimizers[0])
    system.rendering = None
