"""When the rows that no training view needs are removed from static nodes (the paper's second stage)."""

import logging
from collections.abc import Sequence

from lightning import Callback, LightningModule, Trainer

from sparsestreet.pruning import PruningRule, View
from sparsestreet.training.callbacks.resizing import resize_rows
from sparsestreet.training.schedule import milestone

log = logging.getLogger(__name__)


class BackgroundPruning(Callback):
    """At given moments of the run: let a rule look at all training views, and remove the rows it names from some nodes.

    Args:
        at: fractions of the run (the paper: once, at 28,000 of 30,000 steps).
        rule: which rows go.
        min_gaussians: node name -> K_min; the keys are the nodes to prune.
    """

    def __init__(self, at: Sequence[float], rule: PruningRule, min_gaussians: dict[str, int]) -> None:
        self.at = tuple(at)
        self.rule = rule
        self.min_gaussians = dict(min_gaussians)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if trainer.global_step not in {milestone(fraction, trainer.max_steps) for fraction in self.at}:
            return
        unknown = self.min_gaussians.keys() - pl_module.scene.nodes.keys()
        if unknown:
            known = sorted(pl_module.scene.nodes.keys())
            raise ValueError(f"background pruning names nodes {sorted(unknown)}, the scene has {known}")
        view = View(pl_module.options.settings, pl_module.options.backend)
        frames = trainer.datamodule.split.train
        for name, selection in self.rule.select(pl_module.scene, frames, self.min_gaussians, view).items():
            log.info(
                "step %d: background pruning takes %d of %d rows of %r%s",
                trainer.global_step, selection.removed, len(selection.keep), name,
                " (K_min holds)" if selection.floor_hit else "",
            )  # fmt: skip
            if selection.removed:
                resize_rows(trainer, pl_module, name, selection.plan(), "background pruning")
