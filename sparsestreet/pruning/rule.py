"""Interface of the pruning rules: which nodes they may take from, and which rows they keep."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sparsestreet.data.device import to_device
from sparsestreet.ops import contribution
from sparsestreet.pruning.floors import Floors, InstanceAreas
from sparsestreet.scene.gaussians import Selection
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import NodeSettings
from sparsestreet.scene.rendering import DEFAULT_OPTIONS, RenderOptions
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Contribution, Frame


@dataclass(frozen=True)
class RenderContext:
    """How a rule looks at the scene: as training does."""

    state: SceneState = FINISHED
    options: RenderOptions = DEFAULT_OPTIONS


@dataclass(frozen=True, kw_only=True)
class PruningRule(ABC):
    """Decides which rows of some nodes stay."""

    nodes: Sequence[str] | None = None
    """Names of the nodes that it may take from, if they are ``prunable``; None: of all these."""

    @abstractmethod
    def select(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Selection]:
        """What stays of every node that the rule touches, by name: never less than its floors. Without gradients.

        ``frames`` are all training views; each is read when it is indexed.
        """

    def touches(self, name: str, settings: NodeSettings) -> bool:
        """Whether the rule may take from a node."""
        return settings.prunable and (self.nodes is None or name in self.nodes)

    def areas(self, scene: SceneGraph) -> InstanceAreas:
        """Measures the floors of all nodes that the rule touches."""
        return InstanceAreas({name: node for name, node in scene.nodes.items() if self.touches(name, node.settings)})

    def floors(self, scene: SceneGraph, frames: Sequence[Frame], context: RenderContext) -> dict[str, Floors]:
        """Name of every node that the rule touches -> what must stay of it; renders only where instances have floors.

        A rule that goes through ``contributions`` anyway measures the ``areas`` on the way.
        """
        areas = self.areas(scene)
        if areas.needed:
            for view, spans in contributions(scene, frames, context):
                areas.add(view, spans)
        return areas.floors()


def on_device(scene: SceneGraph, frames: Sequence[Frame]) -> Iterator[Frame]:
    """One frame at a time on the scene's device."""
    return (to_device(frame, scene.device) for frame in frames)


def contributions(
    scene: SceneGraph, frames: Sequence[Frame], context: RenderContext
) -> Iterator[tuple[Contribution, dict[str, slice]]]:
    """What every row of the whole scene adds to each view, and name of a node -> its rows."""
    for frame in on_device(scene, frames):
        placed = scene.gaussians_at(frame, context.state)
        options = context.options
        yield (
            contribution(placed.gaussians, placed.view.camera, settings=options.settings, backend=options.backend),
            placed.spans,
        )
