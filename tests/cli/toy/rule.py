"""A pruning rule of one's own: it answers which Gaussians of each prunable node stay."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from sparsestreet.pruning import PruningRule, RenderContext
from sparsestreet.scene.gaussians import Selection, keep_best
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame


@dataclass(frozen=True)
class SizeRule(PruningRule):
    """Gaussians larger than some meters go, the largest first where K_min holds some of them."""

    meters: float

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        selections = {}
        for name, floors in self.floors(scene, frames, context).items():
            sizes = scene.nodes[name].rows.log_scales.amax(1).exp()
            selections[name] = keep_best(-sizes, sizes > self.meters, *floors)
        return selections
