"""Controls of the other rules: as many Gaussians, chosen without looking at what they do in the images."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.pruning.rule import PruningRule, RenderContext
from sparsestreet.scene.gaussians import Rows, Selection, keep_best
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.types import Frame


@dataclass(frozen=True)
class CountRule(PruningRule):
    """A given number of rows stays of each node, those of the highest score; more where a floor asks for more."""

    keep: int | float | Mapping[str, int | float]
    """Of each node alike, or by its name (a node without number keeps all): up to 1 a fraction of the rows that it has
    before the pass, above 1 their number."""

    def __post_init__(self) -> None:
        wrong = [value for value in self._numbers() if not value >= 0]
        if wrong:
            raise ValueError(f"keep must be a fraction in [0, 1] or a number of Gaussians, got {wrong[0]}")

    @abstractmethod
    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """What a node's rows are ranked by."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        selections = {}
        for name, floors in self.floors(scene, frames, context).items():
            scores = self.scores(name, scene.nodes[name].rows)
            unwanted = torch.ones_like(scores, dtype=torch.bool)
            # Of equals the lower row stays, as at the floors.
            unwanted[torch.sort(scores, descending=True, stable=True).indices[: self._count(name, len(scores))]] = False
            selections[name] = keep_best(scores, unwanted, *floors)
        return selections

    def _numbers(self) -> Sequence[int | float]:
        return tuple(self.keep.values()) if isinstance(self.keep, Mapping) else (self.keep,)

    def _count(self, name: str, rows: int) -> int:
        keep = self.keep.get(name, 1.0) if isinstance(self.keep, Mapping) else self.keep
        return round(keep * rows if keep <= 1 else keep)


@dataclass(frozen=True)
class RandomRule(CountRule):
    """Which rows stay is drawn."""

    seed: int = 0

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Each node draws from a stream of its own; the same rows meet the same numbers."""
        drawn = torch.rand(len(rows), generator=named_generator(self.seed, f"pruning {name}"))
        return drawn.to(rows.means.device)


@dataclass(frozen=True)
class OpacityRule(CountRule):
    """The most opaque rows stay, as they are learned, without their mask."""

    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        return rows.opacity_logits
