"""When the rows that no training view needs are removed from static nodes (the paper's second stage)."""

import logging
from collections.abc import Iterator, Sequence

import torch
from lightning import Callback, LightningModule, Trainer

from sparsestreet.ops import contribution
from sparsestreet.pruning.importance import measure_importance
from sparsestreet.pruning.select import keep_by_importance
from sparsestreet.training.callbacks.resizing import resize_rows
from sparsestreet.training.schedule import moment
from sparsestreet.training.system import StreetSystem
from sparsestreet.types import Contribution, Frame

log = logging.getLogger(__name__)


class BackgroundPruning(Callback):
    """At given moments of the run: score every row over all training views, remove the worthless rows of some nodes.

    The whole scene is rendered for the scores (cars hide the road behind them); only the rows of ``nodes`` may go.

    Args:
        at: fractions of the run (the paper: once, at 28,000 of 30,000 steps).
        minimum_rows: node name -> K_min; the keys are the nodes to prune.
        gate: count a view only for rows that are the largest contributor of one of its pixels.
    """

    def __init__(self, at: Sequence[float], minimum_rows: dict[str, int], *, gate: bool = True) -> None:
        self.at = tuple(at)
        self.minimum_rows = dict(minimum_rows)
        self.gate = gate

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        if trainer.global_step not in {moment(fraction, trainer.max_steps) for fraction in self.at}:
            return
        frames = trainer.datamodule.split.train
        with torch.no_grad():
            scores = measure_importance(self._views(pl_module, frames), gate=self.gate)
            spans = pl_module.scene.gaussians_at(frames[0].time).rows
        for name, floor in self.minimum_rows.items():
            if name not in spans:
                raise ValueError(f"background pruning names node {name!r}, the scene has {sorted(spans)}")
            selection = keep_by_importance(scores[spans[name]], floor)
            before = len(pl_module.scene.nodes[name].rows)
            log.info(
                "step %d: %d of %d rows of %r matter in no training view%s",
                trainer.global_step, selection.removed, before, name,
                " (K_min holds)" if selection.floor_hit else "",
            )  # fmt: skip
            if selection.removed:
                resize_rows(trainer, pl_module, name, selection.plan(), "background pruning")

    @staticmethod
    def _views(system: StreetSystem, frames: Sequence[Frame]) -> Iterator[Contribution]:
        for frame in frames:
            gaussians = system.scene.gaussians_at(frame.time).gaussians
            yield contribution(
                gaussians, frame.camera, settings=system.options.settings, backend=system.options.backend
            )
