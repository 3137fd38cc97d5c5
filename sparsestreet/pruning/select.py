"""Which rows of a node a rule removes: floors, a rule's interface, the choice and the counts of many passes."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from sparsestreet.data.frame_cache import to_device
from sparsestreet.ops import contribution
from sparsestreet.pruning.seen import Floors, Gathered, InstanceAreas
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.gaussians import Selection, keep_best
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import NodeSettings
from sparsestreet.scene.rendering import DEFAULT_OPTIONS, RenderOptions
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Contribution, Frame


@dataclass(frozen=True)
class RenderContext:
    """How a rule renders the scene: with the state and options of training; and which pass of how many it is."""

    state: SceneState = FINISHED
    options: RenderOptions = DEFAULT_OPTIONS
    passes: int = 1
    """Number of passes of the run."""
    passed: int = 0
    """Number of passes before this one."""
    ranks: Ranks = ALONE
    """The processes that score together: each looks at its share of the views."""
    gathered: Gathered | None = None
    """What training steps have found out for a rule that ``gathers``; it looks at the other views alone."""


@dataclass(frozen=True, kw_only=True)
class PruningRule(ABC):
    """A rule that decides which rows of some nodes stay."""

    nodes: Sequence[str] | None = None
    """Names of the nodes that it may remove rows from, if they are ``prunable``; None: all prunable nodes."""

    @abstractmethod
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        """Return name of every node that the rule touches -> the rows that stay, never fewer than its floors.

        Computes no gradients. ``frames`` are all training views; each is read when it is indexed.
        """

    @property
    def gathers(self) -> bool:
        """Whether training steps can find out what the rule asks of the views that they show."""
        return False

    def touches(self, name: str, settings: NodeSettings) -> bool:
        """Whether the rule may remove rows from a node."""
        return settings.prunable and (self.nodes is None or name in self.nodes)

    def areas(self, scene: SceneGraph) -> InstanceAreas:
        """Return an accumulator for the floors of all nodes that the rule touches."""
        return InstanceAreas({name: node for name, node in scene.nodes.items() if self.touches(name, node.settings)})

    def floors(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Floors]:
        """Return name of every node that the rule touches -> its floors; render only if instances have floors.

        A rule that needs the blend weights of rows anyway adds them to its own ``areas`` instead.
        """
        areas = self.areas(scene)
        if areas.needed:
            for view, spans in contributions(scene, frames, context):
                areas.add(view.weight, spans)
        return areas.floors(context.ranks)


def on_device(scene: SceneGraph, frames: Sequence[Frame], ranks: Ranks = ALONE) -> Iterator[Frame]:
    """Yield one frame of this process's share at a time, on the scene's device."""
    return (to_device(frame, scene.device) for frame in ranks.share(frames))


def contributions(
    scene: SceneGraph, frames: Sequence[Frame], context: RenderContext
) -> Iterator[tuple[Contribution, dict[str, slice]]]:
    """Yield for each view the contribution of every row of the whole scene, and name of a node -> its rows.

    Of several processes each looks at its share of the views.
    """
    for frame in on_device(scene, frames, context.ranks):
        placed = scene.gaussians_at(frame, context.state)
        options = context.options
        yield (
            contribution(placed.gaussians, placed.view.camera, settings=options.settings, backend=options.backend),
            placed.spans,
        )


def keep_by_importance(scores: Float[Tensor, " n"], floors: Floors) -> Selection:
    """Drops the rows with importance 0, but keeps enough to meet the floors of the node and its instances.

    At a floor the highest scores stay and, among rows of equal score (zero), the lower row. Raises ValueError for
    scores that are NaN or negative, or a negative floor.

    >>> keep_by_importance(torch.tensor([0.5, 0.0, 0.0]), Floors(min_gaussians=2)).keep.tolist()
    [True, True, False]
    """
    if (scores < 0).any():
        raise ValueError(f"importance is a mean blend weight and >= 0, got {float(scores.min())}")
    return keep_best(scores, scores == 0, *floors)


def keep_by_cost(
    costs: Mapping[str, Float[Tensor, " _"]],
    allowed: float,
    floors: Mapping[str, Floors],
    order: Mapping[str, Float[Tensor, " _"]] | None = None,
) -> dict[str, Selection]:
    """Drops the rows of all nodes together, lowest ``order`` first, while their costs add up to ``allowed`` at most.

    ``costs``, ``floors`` and ``order`` (None: the costs) are by name of the node. At a floor the rows that would go
    last stay and, among equals, the lower row; their cost is not spent on others. Raises ValueError for costs or an
    order that are NaN or negative, or a negative floor.

    >>> costs = {"road": torch.tensor([0.1, 0.5]), "cars": torch.tensor([0.2])}
    >>> kept = keep_by_cost(costs, allowed=0.4, floors={"road": Floors(0), "cars": Floors(0)})
    >>> {name: selection.keep.tolist() for name, selection in kept.items()}
    {'road': [False, True], 'cars': [False]}
    """
    if not costs:
        return {}
    order = costs if order is None else order
    every, places = (torch.cat([each.double() for each in one.values()]) for one in (costs, order))
    for one in (every, places):
        if not (one >= 0).all():
            raise ValueError(f"costs of removal must be numbers >= 0, got {float(one[~(one >= 0)][0])}")
    return keep_by_rank(order, int((every[_lowest_first(places)].cumsum(0) <= allowed).sum()), floors)


def keep_by_rank(
    scores: Mapping[str, Float[Tensor, " _"]], number: int, floors: Mapping[str, Floors]
) -> dict[str, Selection]:
    """Drops the ``number`` rows with the lowest scores of all nodes together; otherwise as ``keep_by_cost``.

    Raises ValueError for a number that is negative or above the number of rows, or a negative floor.

    >>> keep_by_rank({"road": torch.tensor([0.1, 0.5])}, number=1, floors={"road": Floors(0)})["road"].keep.tolist()
    [False, True]
    """
    everything = torch.cat([score.double() for score in scores.values()]) if scores else torch.zeros(0).double()
    if not 0 <= number <= len(everything):
        raise ValueError(
            f"{number:,} rows are to go, and the nodes that the rule may take from have {len(everything):,}: take "
            "fewer, or let it take from more nodes"
        )
    unwanted = torch.zeros(len(everything), dtype=torch.bool, device=everything.device)
    unwanted[_lowest_first(everything)[:number]] = True
    parts = unwanted.split([len(score) for score in scores.values()])
    return {name: keep_best(scores[name], part, *floors[name]) for name, part in zip(scores, parts, strict=True)}


def _lowest_first(scores: Float64[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Return the rows in the order in which they go. Among equals the later one goes first, as at the floors."""
    return len(scores) - 1 - torch.sort(scores.flip(0), stable=True).indices


Keep = int | float | Mapping[str, int | float]
"""One value for every node, or name of a node -> its value; a node without a value keeps all rows. Values up to 1 are
fractions of the rows before the first pass; larger ones are numbers of rows."""


def check_keep(keep: Keep) -> None:
    """Raise ValueError for a value that is neither a fraction nor a number of rows."""
    values = keep.values() if isinstance(keep, Mapping) else (keep,)
    wrong = [value for value in values if not value >= 0]
    if wrong:
        raise ValueError(f"keep must be a fraction in [0, 1] or a number of Gaussians, got {wrong[0]}")


def keep_counts(
    scores: Mapping[str, Float[Tensor, " _"]], keep: Keep, floors: Mapping[str, Floors], context: RenderContext
) -> dict[str, Selection]:
    """Keep so many rows of each node, those with the highest scores, or more if a floor demands it.

    Of several passes each leaves the same share of a node's rows, and the last one leaves ``keep``. Among rows of equal
    score the lower one stays. Raises ValueError for scores that are NaN, or a negative floor.

    >>> import torch
    >>> kept = keep_counts({"road": torch.tensor([0.1, 0.9, 0.5])}, 2, {"road": Floors(0)}, RenderContext())
    >>> kept["road"].keep.tolist()
    [False, True, True]
    """
    selections = {}
    for name, floor in floors.items():
        rows = len(scores[name])
        going = rows - min(_count(keep, name, rows, context), rows)
        selections |= keep_by_rank({name: scores[name]}, going, {name: floor})
    return selections


def _count(keep: Keep, name: str, rows: int, context: RenderContext) -> int:
    value = keep.get(name, 1.0) if isinstance(keep, Mapping) else keep
    if value <= 1:
        return round(rows * value ** (1 / context.passes))
    left = context.passes - context.passed
    return round(rows * (value / max(rows, 1)) ** (1 / left))
