"""Controls for the other rules: they keep a given number of Gaussians without looking at the images."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.pruning.counts import Keep, check_keep, keep_counts
from sparsestreet.pruning.rule import PruningRule, RenderContext
from sparsestreet.scene.gaussians import Rows, Selection
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame


@dataclass(frozen=True)
class CountRule(PruningRule):
    """Keeps a given number of each node's rows, those with the highest scores, or more if a floor demands it."""

    keep: Keep
    """How many rows stay (see ``counts.Keep``)."""

    def __post_init__(self) -> None:
        check_keep(self.keep)

    @abstractmethod
    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Returns the scores that rank a node's rows."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        floors = self.floors(scene, frames, context)
        scores = {name: self.scores(name, scene.nodes[name].rows) for name in floors}
        return keep_counts(scores, self.keep, floors, context)


@dataclass(frozen=True)
class RandomRule(CountRule):
    """Keeps rows at random."""

    seed: int = 0

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Returns random numbers from the node's own stream, the same in every pass over the same rows."""
        drawn = torch.rand(len(rows), generator=named_generator(self.seed, f"pruning {name}"))
        return drawn.to(rows.means.device)


@dataclass(frozen=True)
class OpacityRule(CountRule):
    """Keeps the most opaque rows by their learned opacity, without the mask."""

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        return rows.opacity_logits
