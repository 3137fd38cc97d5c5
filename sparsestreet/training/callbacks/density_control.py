"""When to densify, cull and reset opacities (the schedule of 3DGS, as DriveStudio runs it per node)."""

from collections.abc import Mapping

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.training.callbacks.resizing import resize_rows
from sparsestreet.training.density.gradient import GradientDensity, cull, densify, outside_boxes, reset_opacity
from sparsestreet.training.density.statistics import DensityStatistics
from sparsestreet.training.schedule import Interval
from sparsestreet.training.system import StreetSystem

BOX_MARGIN = 0.1
"""Meters by which a rigid row's center may lie outside its box: annotated boxes are about this tight."""


class DensityControl(Callback):
    """Densifies and culls the nodes named in ``nodes`` and resets their opacities.

    Args:
        nodes: settings per node; a node without an entry keeps its rows.
        densify_in: when rows may be split and cloned.
        cull_in: when transparent and oversized rows are dropped (with each densification, and after).
        reset_in: when opacities are pulled down to ``reset_to``, so that what is not needed can be culled.
        pause_after_reset: steps after a reset without densification and culling: opacities must recover first.
        oversize_from: fraction of the run from which oversized rows are culled as well.
        seed: of the positions of split children.
    """

    def __init__(
        self,
        nodes: Mapping[str, GradientDensity],
        densify_in: Interval,
        cull_in: Interval,
        reset_in: Interval,
        *,
        reset_to: float = 0.01,
        pause_after_reset: int = 100,
        oversize_from: float = 0.1,
        seed: int = 0,
    ) -> None:
        self.nodes = dict(nodes)
        self.densify_in, self.cull_in, self.reset_in = densify_in, cull_in, reset_in
        self.reset_to = reset_to
        self.pause_after_reset = pause_after_reset
        self.oversize_from = oversize_from
        self.generator = torch.Generator().manual_seed(seed)
        self.statistics: dict[str, DensityStatistics] = {}
        self.last_reset: int | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        names = [name for name in self.nodes if name in pl_module.scene.nodes]
        for name in names:
            rows = len(pl_module.scene.nodes[name].rows)
            if name not in self.statistics:
                self.statistics[name] = DensityStatistics(rows)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # Only now are rows on their device, and statistics of a checkpoint restored.
        for statistics in self.statistics.values():
            statistics.to(pl_module.device)

    def follow_rows(self, node: str, plan: RowPlan) -> None:
        """Keep statistics beside the rows, whoever resized them."""
        if node in self.statistics:
            self.statistics[node].resize(plan)

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.global_step >= self.cull_in.last(trainer.max_steps):
            return
        splats = pl_module.rendering.splats
        height, width = splats.alpha.shape
        for name, statistics in self.statistics.items():
            span = pl_module.rendering.rows[name]
            statistics.add(splats.screen_offsets.grad[span], splats.radii[span], width, height)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step, steps = trainer.global_step, trainer.max_steps
        if self.cull_in.due(step, steps) and not self._recovering(step):
            for name, settings in self.nodes.items():
                if name in self.statistics:
                    self._refine(trainer, pl_module, name, settings)
        if self.reset_in.due(step, steps):
            self.last_reset = step
            for name in self.statistics:
                resize_rows(trainer, pl_module, name, self._reset_plan(pl_module, name), "opacity reset")

    def _recovering(self, step: int) -> bool:
        return self.last_reset is not None and step - self.last_reset <= self.pause_after_reset

    def _reset_plan(self, system: StreetSystem, name: str) -> RowPlan:
        return reset_opacity(system.scene.nodes[name].rows, self.reset_to)

    def _refine(self, trainer: Trainer, system: StreetSystem, name: str, settings: GradientDensity) -> None:
        """Densify (inside its window), then cull, then start new statistics."""
        step, steps = trainer.global_step, trainer.max_steps
        node, statistics = system.scene.nodes[name], self.statistics[name]
        oversize = step > self.oversize_from * steps
        if self.densify_in.start * steps < step <= self.densify_in.last(steps):
            plan = densify(node.rows, statistics, settings, system.radius, self.generator, use_screen_size=False)
            resize_rows(trainer, system, name, plan, "densify")
        plan = cull(node.rows, statistics, settings, system.radius, use_scale=oversize, use_screen=False)
        resize_rows(trainer, system, name, plan, "cull")
        outside = self._outside(node)
        if outside is not None and bool(outside.any()):
            resize_rows(trainer, system, name, RowPlan.keep(~outside), "outside its box")
        statistics.reset()

    @staticmethod
    def _outside(node: torch.nn.Module) -> Tensor | None:
        """Rows that left the box of their instance; None for a node without boxes."""
        sizes = getattr(node, "sizes", None)
        if sizes is None:
            return None
        return outside_boxes(node.rows.means.detach(), node.rows.instances, sizes, margin=BOX_MARGIN)

    def state_dict(self) -> dict[str, object]:
        return {
            "statistics": {name: statistics.state_dict() for name, statistics in self.statistics.items()},
            "generator": self.generator.get_state(),
            "last_reset": self.last_reset,
        }

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.statistics = {name: DensityStatistics.from_state(s) for name, s in state_dict["statistics"].items()}
        self.generator.set_state(state_dict["generator"])
        self.last_reset = state_dict["last_reset"]
