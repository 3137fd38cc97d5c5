"""When to densify, cull and reset opacities (the schedule of 3DGS, as DriveStudio runs it per node)."""

import logging
import math
from functools import partial
from typing import Any

import torch
from lightning import Callback, Trainer
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor
from torch.utils.hooks import RemovableHandle

from sparsestreet.codec.vectors import curve_order
from sparsestreet.phases import phase
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.records.curves import CountChange
from sparsestreet.scene.density import DensityStatistics, DensityStrategy
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.generators import named_seed
from sparsestreet.scene.nodes.node import Node
from sparsestreet.training.forecast import bytes_for_growth, bytes_of_row
from sparsestreet.training.lightning import begins_step, callbacks_of, data_of, ends_step, ranks_of
from sparsestreet.training.parallel import check_agreement
from sparsestreet.training.schedule import Interval, last_step
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


def end_mask(trainer: Trainer, system: StreetSystem, node: str) -> None:
    """Finish a node's mask, and take what it learned out of the optimizer."""
    system.scene.nodes[node].finish_mask(trainer.optimizers[0])
    system.rendering = None


class DensityControl(Callback, RowListener):
    """Refines every node that has a density strategy, and resets its opacities; what happens is the strategy's matter.

    No more rows are added than memory has room for; a run that is held back says so, and goes on.

    Args:
        refine_in: when rows that are of no use are culled and, up to ``densify_until``, others split and cloned before.
        densify_until: fraction of the run after which no rows are added any more, unless a node's settings say another.
        reset_in: when opacities are pulled down, so that what is not needed can be culled.
        pause_after_reset: steps (of one image) after a reset without refinement: opacities must recover first. None, as
            in DriveStudio: no refinement in the first steps of each period of ``reset_in``, as many as there are
            training images and at least ``refine_in.every``; statistics start anew at each refinement that falls out.
        first_counts_all: as in ``DensityStatistics``.
        seed: of the positions of split children, of rows drawn and of noise.

    Raises ValueError at the start of a training whose periods are shorter than the pause.
    """

    def __init__(
        self,
        refine_in: Interval,
        densify_until: float,
        reset_in: Interval,
        *,
        pause_after_reset: int | None = 100,
        first_counts_all: bool = False,
        seed: int = 0,
    ) -> None:
        if not refine_in.start <= densify_until <= refine_in.stop:
            raise ValueError(
                f"densify_until must lie between refine_in.start and refine_in.stop, got {densify_until} for "
                f"{refine_in.start} to {refine_in.stop}: densification is a part of the refinement"
            )
        self.refine_in, self.densify_until, self.reset_in = refine_in, densify_until, reset_in
        self.pause_after_reset = pause_after_reset
        self.first_counts_all = first_counts_all
        self.closed_steps = 0
        self.seed, self.generator = seed, torch.Generator().manual_seed(seed)
        self.statistics: dict[str, DensityStatistics] = {}
        self._of_others: list[dict[str, DensityStatistics]] = []
        """In a checkpoint of several processes: of those behind the first."""
        self._ranks = ALONE
        self._hooks: list[RemovableHandle] = []
        self._gradients: dict[str, dict[str, Tensor]] = {}
        """Node, watched column -> its gradient in the image that was differentiated last."""
        self.last_reset: int | None = None
        self.first_counts: dict[str, int] = {}
        """Node -> rows at the start of the training."""

    def setup(self, trainer: Trainer, pl_module: StreetSystem, stage: str) -> None:
        for name, node in pl_module.scene.nodes.items():
            if (strategy := node.settings.density) is not None:
                empty = DensityStatistics(
                    len(node.rows), watched=strategy.watched, first_counts_all=self.first_counts_all
                )
                self.statistics.setdefault(name, empty)
                self.first_counts.setdefault(name, len(node.rows))

    def on_train_start(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        # Only now are rows on their device, and statistics of a checkpoint restored.
        self._ranks = ranks_of(trainer)
        self._take_own(self._ranks)
        for statistics in self.statistics.values():
            statistics.to(pl_module.device)
        if self.pause_after_reset is None:
            images = len(data_of(trainer).split.train)
            self.closed_steps = max(images, self.refine_in.every)
            if self.closed_steps >= self.reset_in.every:
                raise ValueError(
                    f"the {images} training images fill the {self.reset_in.every} steps between two opacity resets, so "
                    "nothing would ever be refined: set schedule.pause_after_reset, or raise schedule.reset_in.every"
                )

    def on_rows_changed(self, change: CountChange, plan: RowPlan) -> None:
        """Keep statistics beside the rows, whoever changed them."""
        if change.node in self.statistics:
            self.statistics[change.node].resize(plan)

    def on_before_backward(self, trainer: Trainer, pl_module: StreetSystem, loss: Tensor) -> None:
        """Look at the gradients of watched columns as they come: columns add up those of all images of a step."""
        if pl_module.screen_gradients and trainer.accumulate_grad_batches > 1:
            for name, statistics in self.statistics.items():
                columns, seen = pl_module.scene.nodes[name].rows.columns(), self._gradients.setdefault(name, {})
                self._hooks += [
                    columns[column].register_hook(partial(seen.__setitem__, column)) for column in statistics.watched
                ]

    def on_after_backward(self, trainer: Trainer, pl_module: StreetSystem) -> None:
        if not pl_module.screen_gradients:
            return
        images = pl_module.course.images_per_step
        rendering = pl_module.rendering
        assert rendering is not None  # the backward pass of this step went through it
        splats, gradients = rendering.splats, rendering.splats.screen_gradients
        height, width = splats.alpha.shape
        with phase("density statistics"):
            for name, statistics in self.statistics.items():
                span = rendering.spans[name]
                columns = pl_module.scene.nodes[name].rows.columns()
                found = ((column, columns[column].grad) for column in statistics.watched)
                watched = {column: gradient for column, gradient in found if gradient is not None}
                watched |= self._gradients.pop(name, {})
                seen = gradients[span]
                if images > 1:
                    # The loss is a mean over the images of the step, thresholds are for that of one.
                    seen, watched = images * seen, {column: images * one for column, one in watched.items()}
                    statistics.is_empty &= self._ranks.rank == 0  # whose image is the first of the step
                statistics.add(seen, splats.radii[span], width, height, watched)
        while self._hooks:
            self._hooks.pop().remove()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: StreetSystem, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if not ends_step(trainer, batch_idx):
            return
        step = trainer.global_step
        for name in self.statistics:
            self._shake(trainer, pl_module, name)
        if not self.refine_in.due(step, pl_module.course):
            return
        for name, statistics in self.statistics.items():
            if not self._recovering(step, pl_module.course.images_per_step):
                statistics.total(self._ranks)
                self._refine(trainer, pl_module, name)
            elif self.pause_after_reset is None:
                statistics.reset()
        check_agreement(pl_module.scene, self._ranks)

    def on_train_batch_start(self, trainer: Trainer, pl_module: StreetSystem, batch: object, batch_idx: int) -> None:
        last = self.refine_in.last(pl_module.course)
        pl_module.screen_gradients = bool(self.statistics) and trainer.global_step < last
        # Before the next step rather than behind the last one: a look at held-out views that falls between the two
        # would see a scene that has just lost its opacities.
        step = trainer.global_step
        if step > 0 and begins_step(trainer, batch_idx) and self.reset_in.due(step, pl_module.course):
            self.last_reset = step
            for name in self.statistics:
                node = pl_module.scene.nodes[name]
                resize_rows(trainer, pl_module, name, _strategy(node).reset(node.rows), "opacity reset")

    @torch.no_grad()
    def _shake(self, trainer: Trainer, system: StreetSystem, name: str) -> None:
        """Add what noise the strategy asks for; a resumed run has the same, because it follows from the step."""
        node = system.scene.nodes[name]
        means = node.rows.means
        (rate,) = (g["lr"] for g in trainer.optimizers[0].param_groups if any(means is one for one in g["params"]))
        noise = _strategy(node).noise(node.rows, rate, named_seed(self.seed, f"noise {name} {trainer.global_step}"))
        if noise is not None:
            means += noise

    def _recovering(self, step: int, images: int) -> bool:
        if self.pause_after_reset is None:
            return images * step % self.reset_in.every <= self.closed_steps
        return self.last_reset is not None and images * (step - self.last_reset) <= self.pause_after_reset

    def _refine(self, trainer: Trainer, system: StreetSystem, name: str) -> None:
        """Densify (while it is time), then cull, then start new statistics."""
        step, course = trainer.global_step, system.course
        node, statistics = system.scene.nodes[name], self.statistics[name]
        strategy = _strategy(node)
        when = {"radius": system.radius, "progress": course.progress(step)}
        until = self.densify_until if node.settings.densify_until is None else node.settings.densify_until
        if step <= last_step(until, course):
            limit, drawn = self._limit(name, node, course.progress(step) / until), self.generator.get_state()
            plan = strategy.densify(node.rows, statistics, max_gaussians=limit, generator=self.generator, **when)
            fits = self._fits(trainer, system, name, len(plan.source) - len(node.rows))
            if fits is not None:
                self.generator.set_state(drawn)
                plan = strategy.densify(node.rows, statistics, max_gaussians=fits, generator=self.generator, **when)
            resize_rows(trainer, system, name, plan, "densify")
        culled = strategy.cull(node.rows, statistics, **when)
        if node.instances() is None:
            culled = _along_curve(culled, node.rows.means)
        resize_rows(trainer, system, name, culled, "cull")
        outside = node.outside()
        if outside is not None and bool(outside.any()):
            resize_rows(trainer, system, name, RowPlan.keep(~outside), "outside its box")
        statistics.reset()

    def _limit(self, name: str, node: Node, grown: float) -> int | None:
        """Return how many rows a node may have once this share of its growth is over; None: any number."""
        limit = node.settings.max_gaussians
        if limit is None or not node.settings.limit_rises:
            return limit
        first = min(self.first_counts[name], limit)
        return first + math.floor((limit - first) * min(grown, 1.0))

    def _fits(self, trainer: Trainer, system: StreetSystem, name: str, added: int) -> int | None:
        """Rows that a node may have where memory has no room for all that would be added; None where it has."""
        rows = system.scene.nodes[name].rows
        if added <= 0:
            return None
        free, needed = bytes_for_growth(system.device), bytes_of_row(rows, moved=system.moved_views is not None)
        if self._ranks.size > 1:  # all do what the fullest one can
            device = system.device
            free = -float(self._ranks.largest(torch.tensor(-free, dtype=torch.float64, device=device)))
        if added * needed <= free:
            return None
        room = max(math.floor(free / needed), 0)
        if not system.held_back:
            log.warning(
                "step %d: %r would grow by %s Gaussians of %s bytes each, and memory has room for %s: no more are "
                "added. Further ones are counted, and said at the end; a lower max_gaussians would decide it",
                trainer.global_step, name, f"{added:,}", f"{needed:,.0f}", f"{room:,}",
            )  # fmt: skip
        system.held_back[name] = system.held_back.get(name, 0) + added - room
        return len(rows) + room

    def _take_own(self, ranks: Ranks) -> None:
        """Of the statistics of a checkpoint, those of this process; the first takes all if they are another number."""
        if len(self._of_others) == ranks.size - 1:
            self.statistics = [self.statistics, *self._of_others][ranks.rank]
        else:
            for name, statistics in self.statistics.items():
                for others in self._of_others if ranks.rank == 0 else ():
                    statistics.absorb(others[name])
                if ranks.rank:
                    statistics.reset()
        self._of_others = []

    def state_dict(self) -> dict[str, Any]:
        """Several processes ask for it together."""
        own = {name: statistics.state_dict() for name, statistics in self.statistics.items()}
        state = {"statistics": own, "generator": self.generator.get_state(), "last_reset": self.last_reset}
        state["first_counts"] = self.first_counts
        if self._ranks.size > 1:
            state["of_others"] = self._ranks.gathered(move_data_to_device(own, "cpu"))[1:]
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        first, *self._of_others = (
            {name: DensityStatistics.from_state(one) for name, one in statistics.items()}
            for statistics in (state_dict["statistics"], *state_dict.get("of_others", ()))
        )
        self.statistics = first
        self.generator.set_state(state_dict["generator"])
        self.last_reset, self.first_counts = state_dict["last_reset"], dict(state_dict["first_counts"])


def _along_curve(plan: RowPlan, means: Tensor) -> RowPlan:
    """Return the plan with its rows along a curve that fills space: a tile's splats then lie near each other in memory.

    A frame of 135,484 rows takes 22 % less time so (docs/time_and_memory.md).
    """
    kept = plan.edits.get("means", means.detach()[plan.source])
    order = curve_order(kept.double().cpu().numpy())
    return plan.reordered(torch.from_numpy(order).to(means.device))


def _strategy(node: Node) -> DensityStrategy:
    assert node.settings.density is not None  # statistics are kept for such nodes alone
    return node.settings.density
