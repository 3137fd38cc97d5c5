"""Interface of the pruning rules: the nodes that a rule may remove rows from, and the rows that it keeps."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sparsestreet.data.frame_cache import to_device
from sparsestreet.ops import contribution
from sparsestreet.pruning.floors import Floors, InstanceAreas
from sparsestreet.ranks import ALONE, Ranks
from sparsestreet.scene.gaussians import Selection
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


@dataclass(frozen=True, kw_only=True)
class PruningRule(ABC):
    """A rule that decides which rows of some nodes stay."""

    nodes: Sequence[str] | None = None
    """Names of the nodes that it may remove rows from, if they are ``prunable``; None: all prunable nodes."""

    @abstractmethod
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        """Returns name of every node that the rule touches -> the rows that stay, never fewer than its floors.

        Computes no gradients. ``frames`` are all training views; each is read when it is indexed.
        """

    def touches(self, name: str, settings: NodeSettings) -> bool:
        """Whether the rule may remove rows from a node."""
        return settings.prunable and (self.nodes is None or name in self.nodes)

    def areas(self, scene: SceneGraph) -> InstanceAreas:
        """Returns an accumulator for the floors of all nodes that the rule touches."""
        return InstanceAreas({name: node for name, node in scene.nodes.items() if self.touches(name, node.settings)})

    def floors(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Floors]:
        """Returns name of every node that the rule touches -> its floors; renders only if instances have floors.

        A rule that needs ``contributions`` anyway adds them to its own ``areas`` instead.
        """
        areas = self.areas(scene)
        if areas.needed:
            for view, spans in contributions(scene, frames, context):
                areas.add(view, spans)
        return areas.floors(context.ranks)


def on_device(scene: SceneGraph, frames: Sequence[Frame], ranks: Ranks = ALONE) -> Iterator[Frame]:
    """Yields one frame of this process's share at a time, on the scene's device."""
    return (to_device(frame, scene.device) for frame in ranks.share(frames))


def contributions(
    scene: SceneGraph, frames: Sequence[Frame], context: RenderContext
) -> Iterator[tuple[Contribution, dict[str, slice]]]:
    """Yields for each view the contribution of every row of the whole scene, and name of a node -> its rows.

    Of several processes each looks at its share of the views.
    """
    for frame in on_device(scene, frames, context.ranks):
        placed = scene.gaussians_at(frame, context.state)
        options = context.options
        yield (
            contribution(placed.gaussians, placed.view.camera, settings=options.settings, backend=options.backend),
            placed.spans,
        )
