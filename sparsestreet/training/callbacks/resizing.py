"""The one way in which callbacks change a node's rows during training."""

import logging

from lightning import Trainer

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.callbacks.row_ledger import RowLedger
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)


def resize_rows(trainer: Trainer, system: StreetSystem, node: str, plan: RowPlan, reason: str) -> None:
    """Apply a plan to a node's rows and the optimizer, drop the stale graph, and tell whoever keeps row statistics."""
    rows = system.scene.nodes[node].rows
    before = len(rows)
    rows.resize(plan, trainer.optimizers[0])
    system.rendering = None
    for callback in trainer.callbacks:
        follow = getattr(callback, "follow_rows", None)
        if follow is not None:
            follow(node, plan)
        if isinstance(callback, RowLedger) and len(rows) != before:
            callback.record(trainer.global_step, node, before, len(rows), reason)
    log.debug("step %d: %s %s, %d -> %d rows", trainer.global_step, node, reason, before, len(rows))
