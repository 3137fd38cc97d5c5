"""When the rows that no training view needs are removed from the nodes that allow it (the paper's second stage)."""

import logging
from collections.abc import Sequence

from lightning import Callback, Trainer

from sparsestreet.phases import stage
from sparsestreet.pruning import PruningRule, RenderContext
from sparsestreet.training.callbacks.resizing import compare_rows, resize_rows
from sparsestreet.training.lightning import data_of, ends_step, ranks_of
from sparsestreet.training.schedule import milestone
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

REASON = "pruning"


class Pruning(Callback):
    """At given moments of the run: let a rule look at all training views, and remove the rows it names.

    Args:
        at: fractions of the run (the paper: once, at 28,000 of 30,000 steps).
        rule: which rows go of which ``prunable`` nodes, down to the floors of nodes and instances.
    """

    def __init__(self, at: Sequence[float], rule: PruningRule) -> None:
        self.at = tuple(at)
        self.rule = rule

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        moments = sorted({milestone(fraction, pl_module.course) for fraction in self.at})
        if trainer.global_step not in moments:
            return
        with stage(f"prune/{type(self.rule).__name__} at step {trainer.global_step}"):
            passed = moments.index(trainer.global_step)
            context = RenderContext(pl_module.state(), pl_module.options, len(moments), passed, ranks_of(trainer))
            self._prune(trainer, pl_module, context)
            compare_rows(trainer, pl_module)

    def _prune(self, trainer: Trainer, pl_module: StreetSystem, context: RenderContext) -> None:
        frames = data_of(trainer).split.train
        for name, selection in self.rule.select(pl_module.scene, frames, context).items():
            log.info(
                "step %d: pruning takes %d of %d Gaussians of %r%s",
                trainer.global_step, selection.removed, len(selection.keep), name,
                " (a floor holds)" if selection.floor_hit else "",
            )  # fmt: skip
            if selection.removed:
                resize_rows(trainer, pl_module, name, selection.plan(), REASON)
