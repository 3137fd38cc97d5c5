"""When masked Gaussians are removed for good, and when the masks have done their work."""

import logging

from lightning import Callback, LightningModule, Trainer

from sparsestreet.pruning.select import keep_by_mask
from sparsestreet.training.callbacks.resizing import resize_rows
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)


class MaskTraining(Callback):
    """Removes rows whose mask fell to the threshold; at the end of the window fixes M = 1 and drops the masks.

    A row with M = 0 has alpha 0, gets no image gradient and can never come back: removing it at once changes no
    image, only the time a step takes.
    """

    def __init__(self, remove_in: Interval) -> None:
        self.remove_in = remove_in

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step, steps = trainer.global_step, trainer.max_steps
        last = self.remove_in.closes(step, steps)
        if not last and not self.remove_in.due(step, steps):
            return
        for name, node in pl_module.scene.nodes.items():
            if node.mask_scores() is None:
                continue
            self._remove(trainer, pl_module, name)
            if last:
                node.rows.drop_column("mask_logits", trainer.optimizers[0])
                pl_module.rendering = None

    def _remove(self, trainer: Trainer, system: StreetSystem, name: str) -> None:
        node = system.scene.nodes[name]
        selection = keep_by_mask(node.mask_scores().detach(), node.mask.threshold, node.mask.min_gaussians)
        if selection.floor_hit:
            log.info(
                "step %d: the floor of %d rows (K_min) of node %r holds: masks of the best rows stay open",
                trainer.global_step, node.mask.min_gaussians, name,
            )  # fmt: skip
        if selection.removed:
            resize_rows(trainer, system, name, selection.plan(), "mask")
