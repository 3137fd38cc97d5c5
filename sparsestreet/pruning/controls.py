"""Controls for the other rules: they keep a given number of Gaussians without looking at the images."""

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
    """Keeps a given number of each node's rows, those with the highest scores, or more if a floor demands it."""

    keep: int | float | Mapping[str, int | float]
    """One value for every node, or name of a node -> its value; a node without a value keeps all rows. Values up to 1
    are fractions of the rows before the pass; larger ones are numbers of rows."""

    def __post_init__(self) -> None:
        wrong = [value for value in self._numbers() if not value >= 0]
        if wrong:
            raise ValueError(f"keep must be a fraction in [0, 1] or a number of Gaussians, got {wrong[0]}")

    @abstractmethod
    def scores(self, name: str, rows: Rows) -> Float[Tensor, " n"]:
        """Returns the scores that rank a node's rows."""

    @torch.no_grad()
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        selections = {}
        for name, floors in self.floors(scene, frames, context).items():
            scores = self.scores(name, scene.nodes[name].rows)
            unwanted = torch.ones_like(scores, dtype=torch.bool)
            # Among equal scores the lower row stays, as at the floors.
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
