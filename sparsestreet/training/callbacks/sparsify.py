"""When masked Gaussians are removed for good, and when the masks have done their work."""

import logging
from collections.abc import Sequence
from typing import Any

from lightning import Callback, Trainer

from sparsestreet.data.lazy import as_frames
from sparsestreet.phases import stage
from sparsestreet.pruning import Gathered, PruningRule, RenderContext, regions
from sparsestreet.ranks import ALONE
from sparsestreet.records.curves import CountChange
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.masks import Mask
from sparsestreet.training.callbacks.density_control import RowListener, end_mask, resize_rows
from sparsestreet.training.lightning import data_of, ends_step, ranks_of
from sparsestreet.training.parallel import check_agreement
from sparsestreet.training.schedule import Interval, milestone
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Frame

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


class Pruning(Callback, RowListener):
    """At given moments of the run: let a rule look at all training views, and remove the rows it names.

    A rule that ``gathers`` does not look at a view whose last step before the moment has said all that it asks. It
    looks at the others: those that were last shown before rows were added, or by a step that can say nothing (on small
    images, or with rows that a mask hides).

    Args:
        at: fractions of the run (the paper: once, at 28,000 of 30,000 steps).
        rule: which rows go of which ``prunable`` nodes, down to the floors of nodes and instances.
    """

    def __init__(self, at: Sequence[float], rule: PruningRule) -> None:
        self.at = tuple(at)
        self.rule = rule
        self._moment = 0
        """The step for which is gathered."""
        self._draws: frozenset[int] = frozenset()
        """Which images, in the order of training, are the last of their view before the moment."""
        self._gathered: Gathered | None = None
        self._frame: Frame | None = None
        """Of the step that is under way, if it gathers."""
        self._restored: dict[str, Any] = {}
        self._ranks = ALONE

    @property
    def state_key(self) -> str:
        return f"{type(self).__name__} at {self.at}"

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        self._ranks = ranks_of(trainer)

    def on_train_batch_start(self, trainer: Trainer, pl_module: StreetSystem, batch: object, batch_idx: int) -> None:
        if not self.rule.gathers:
            return
        step, course = trainer.global_step, pl_module.course
        moment = next((moment for moment in self._moments(pl_module) if moment > step), 0)
        accumulated = trainer.accumulate_grad_batches
        if moment != self._moment:
            self._draws = data_of(trainer).last_draws(moment * accumulated) if moment else frozenset()
            self._moment, self._gathered = moment, self._begin(pl_module, moment)
        gathers = accumulated * step + batch_idx % accumulated in self._draws
        # On small images there is less of everything to sum.
        whole = pl_module.resolution.divisor(step, course) == 1
        self._frame = batch if gathers and whole and isinstance(batch, Frame) else None
        pl_module.pixel_weights = None if self._frame is None else regions(self._frame)

    def on_after_backward(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if self._frame is not None and self._gathered is not None and pl_module.rendering is not None:
            self._gathered.add(self._frame, pl_module.rendering)

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        if self._gathered is not None:
            self._gathered.resize(change.node, plan)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        moments = self._moments(pl_module)
        if trainer.global_step not in moments:
            return
        with stage(f"prune/{type(self.rule).__name__} at step {trainer.global_step}"):
            passed, ranks = moments.index(trainer.global_step), ranks_of(trainer)
            gathered, self._gathered = self._gathered, None
            state = pl_module.state()
            context = RenderContext(state, pl_module.options, len(moments), passed, ranks, gathered)
            self._prune(trainer, pl_module, context)
            check_agreement(pl_module.scene, context.ranks)

    def _prune(self, trainer: Trainer, pl_module: StreetSystem, context: RenderContext) -> None:
        frames = data_of(trainer).split.train
        if context.gathered is not None and (rest := len(context.gathered.rest(as_frames(frames), context.ranks))):
            log.info(
                "step %d: pruning looks at %d of %d views, of which the steps before it have not said all that it asks",
                trainer.global_step, rest, len(frames),
            )  # fmt: skip
        for name, selection in self.rule.select(pl_module.scene, frames, context).items():
            log.info(
                "step %d: pruning takes %d of %d Gaussians of %r%s",
                trainer.global_step, selection.removed, len(selection.keep), name,
                " (a floor holds)" if selection.floor_hit else "",
            )  # fmt: skip
            if selection.removed:
                resize_rows(trainer, pl_module, name, selection.plan(), PRUNED)

    def _moments(self, system: StreetSystem) -> list[int]:
        return sorted({milestone(fraction, system.course) for fraction in self.at})

    def _begin(self, system: StreetSystem, moment: int) -> Gathered | None:
        """Nothing yet, or what a checkpoint holds for the moment."""
        if not moment:
            return None
        gathered = Gathered(system.scene, self.rule.areas(system.scene))
        if self._restored.get("moment") == moment and self._ranks.rank == 0:
            gathered.load_state_dict(self._restored["gathered"])
        self._restored = {}
        return gathered

    def state_dict(self) -> dict[str, Any]:
        """Several processes ask for it together."""
        if self._gathered is None:
            return {}
        return {"moment": self._moment, "gathered": self._gathered.state_dict(self._ranks)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._restored = state_dict
