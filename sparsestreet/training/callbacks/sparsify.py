"""When masked Gaussians are removed for good, and when the masks have done their work."""

import logging
from collections.abc import Sequence

from lightning import Callback, Trainer

from sparsestreet.phases import stage
from sparsestreet.pruning import PruningRule, RenderContext
from sparsestreet.scene.masks import Mask
from sparsestreet.training.callbacks.density_control import end_mask, resize_rows
from sparsestreet.training.lightning import data_of, ends_step, ranks_of
from sparsestreet.training.parallel import check_agreement
from sparsestreet.training.schedule import Interval, milestone
from sparsestreet.training.system import StreetSystem

log = logging.getLogger(__name__)

MASKED = "mask"


class MaskTraining(Callback):
    """Removes rows that their mask has closed; at the end of the interval the masks are finished.

    A row with M = 0 has alpha 0, gets no image gradient and can never come back: removing it at once changes no
    image, only the time a step takes.
    """

    def __init__(self, remove_in: Interval) -> None:
        self.remove_in = remove_in
        self._said: set[str] = set()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        step, course = trainer.global_step, pl_module.course
        last = self.remove_in.closes(step, course)
        if not last and not self.remove_in.due(step, course):
            return
        for name, node in pl_module.scene.nodes.items():
            if node.mask is not None:
                self._remove(trainer, pl_module, name, node.mask)
                if last:
                    end_mask(trainer, pl_module, name)
        check_agreement(pl_module.scene, ranks_of(trainer))

    def _remove(self, trainer: Trainer, system: StreetSystem, name: str, mask: Mask) -> None:
        node = system.scene.nodes[name]
        selection = mask.keep(node.rows)
        firings = int(mask.floor_firings)
        if selection.floor_hit or firings:
            # A node that is below its floor holds it at every removal: the first one is news.
            log.log(
                logging.DEBUG if name in self._said else logging.INFO,
                "step %d: the floor of %d Gaussians (K_min) of node %r held in %d steps since the last removal: "
                "masks of the best rows stay open",
                trainer.global_step, node.settings.min_gaussians, name, firings,
            )  # fmt: skip
            mask.floor_firings = 0
            self._said.add(name)
        if selection.removed:
            resize_rows(trainer, system, name, selection.plan(), MASKED)


PRUNED = "pruning"


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
            check_agreement(pl_module.scene, context.ranks)

    def _prune(self, trainer: Trainer, pl_module: StreetSystem, context: RenderContext) -> None:
        frames = data_of(trainer).split.train
        for name, selection in self.rule.select(pl_module.scene, frames, context).items():
            log.info(
                "step %d: pruning takes %d of %d Gaussians of %r%s",
                trainer.global_step, selection.removed, len(selection.keep), name,
                " (a floor holds)" if selection.floor_hit else "",
            )  # fmt: skip
            if selection.removed:
                resize_rows(trainer, pl_module, name, selection.plan(), PRUNED)
