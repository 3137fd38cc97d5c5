"""The scene graph: nodes and effects by name, one list of Gaussians in a view."""

import copy
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.effects.effect import Effect, Exposed
from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.learning_rate import LearningRate, matching_rate
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, Node
from sparsestreet.scene.state import FINISHED, SceneState
from sparsestreet.types import Gaussians, View


@dataclass(frozen=True)
class SceneGaussians:
    """All nodes' Gaussians in a view, in the order of the nodes."""

    gaussians: Gaussians
    spans: dict[str, slice]
    """Name of a node -> its rows in ``gaussians``."""
    parts: dict[str, RawGaussians]
    """Name of a node -> what it answered."""
    view: View
    """As nodes and splats see it (``SceneGraph.seen``)."""
    gates: Float[Tensor, " n"] | None = None
    """What masks that sample have drawn for this training step; None: nothing."""


class SceneGraph(nn.Module):
    """Nodes by name, and the effects that they are seen through, in the order in which these act.

    Raises ValueError without any node, or where a node and an effect share a name.
    """

    def __init__(self, nodes: Mapping[str, Node], effects: Mapping[str, Effect] | None = None) -> None:
        super().__init__()
        if not nodes:
            raise ValueError("a scene needs at least one node, got none: add a background")
        effects = effects or {}
        if shared := nodes.keys() & effects.keys():
            raise ValueError(f"a node and an effect are both named {', '.join(sorted(shared))}: rename one of them")
        # To a type checker a ModuleDict holds any modules.
        self.nodes = cast("MutableMapping[str, Node]", nn.ModuleDict(nodes))
        self.effects = cast("MutableMapping[str, Effect]", nn.ModuleDict(effects))

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    def seen(self, view: View, state: SceneState = FINISHED) -> View:
        """What the effects make of a view before nodes and splats see it."""
        for effect in self.effects.values():
            view = effect.view(view, state)
        return view

    def gaussians_at(self, view: View, state: SceneState = FINISHED) -> SceneGaussians:
        """Activated Gaussians of all nodes in the world, seen from a view through the effects."""
        view = self.seen(view, state)
        parts = {name: node.raw_at(view, state) for name, node in self.nodes.items()}
        spans, start = {}, 0
        for name, part in parts.items():
            spans[name] = slice(start, start + len(part))
            start += len(part)
        gaussians = self._activated(list(parts.values()), state)
        if view.camera.shutter is not None and view.camera.shutter.span > 0:
            gaussians = replace(gaussians, displacements=self.displacements(view, parts, view.camera.shutter.span))
        return SceneGaussians(gaussians, spans, parts, view, self._gates(state) if state.training else None)

    def _activated(self, parts: Sequence[RawGaussians], state: SceneState) -> Gaussians:
        if state.harmonics_rest:
            parts = [replace(part, sh_rest=part.sh_rest.detach()) for part in parts]
        return activate(parts, sh_degree=state.sh_degree)

    def exposed(self, view: View) -> Exposed | None:
        """What the view gathers its light over, by the effects; None: nothing blurs it."""
        found = (effect.exposed(view) for effect in self.effects.values())
        return next((one for one in found if one is not None), None)

    def gain(self, view: View) -> Float[Tensor, "3"]:
        """Return factors by which the camera makes red, green and blue of this view brighter than of others."""
        factors = torch.ones(3, device=self.device)
        for effect in self.effects.values():
            own = effect.gain(view)
            factors = factors if own is None else factors * own
        return factors

    @torch.no_grad()
    def displacements(self, view: View, parts: Mapping[str, RawGaussians], span: float) -> Float[Tensor, "n 3"]:
        """How far each row moves in the world, meters, during a normalized time around the view's."""
        moves = {name: self.nodes[name].displacements_over(span, view, part) for name, part in parts.items()}
        return torch.cat([torch.zeros_like(parts[name].means) if one is None else one for name, one in moves.items()])

    def _gates(self, state: SceneState) -> Float[Tensor, " n"] | None:
        """Those of all nodes; 1 for the rows of nodes without, None where no node has any."""
        drawn = [None if node.mask is None else node.mask.gates(node.rows, state.step) for node in self.nodes.values()]
        if all(gates is None for gates in drawn):
            return None
        nodes = self.nodes.values()
        open_gates = (node.rows.means.new_ones(len(node.rows)) for node in nodes)
        return torch.cat([one if gates is None else gates for gates, one in zip(drawn, open_gates, strict=True)])

    def counts(self) -> dict[str, int]:
        """Number of rows of every node, absent instances included."""
        return {name: len(node.rows) for name, node in self.nodes.items()}

    def regularizers(
        self, view: View, parts: Mapping[str, RawGaussians], drawn: Mapping[str, Bool[Tensor, " _"]], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """The weighted terms of all nodes and effects, named node/term and effect/term.

        ``parts`` is what the nodes answered for the view, ``drawn`` which of their rows it shows.
        """
        terms = {name: node.regularizers(view, parts[name], drawn[name], state) for name, node in self.nodes.items()}
        terms |= {name: effect.regularizers(view, state) for name, effect in self.effects.items()}
        return {f"{name}/{term}": value for name, own in terms.items() for term, value in own.items()}

    def learning_rates(self) -> dict[str, LearningRate]:
        """Dotted name of every parameter -> its rate. Raises ValueError, naming where to add it, for a missing one."""
        rates = {}
        for modules, group, key in ((self.nodes, "nodes", "node"), (self.effects, "effects", "effects")):
            for name, module in modules.items():
                for parameter, _ in module.named_parameters():
                    where = f"{key}.{name}.learning_rates"
                    rate = matching_rate(parameter, module.settings.learning_rates, where)
                    rates[f"{group}.{name}.{parameter}"] = rate
        return rates

    def bytes_by_part(self) -> dict[str, int]:
        """float32 bytes of what has to be stored: every node's rows (no masks), ``poses``, every effect that learns."""
        parts = {name: node.row_bytes() for name, node in self.nodes.items()}
        parts["poses"] = sum(node.pose_bytes() for node in self.nodes.values())
        for name, effect in self.effects.items():
            numbers = sum(parameter.numel() for parameter in effect.parameters())
            parts |= {name: BYTES_PER_NUMBER * numbers} if numbers else {}
        return parts

    def without(self, name: str) -> "SceneGraph":
        """The scene with a node or an effect left out; the others are the same modules.

        A lone node stays, without rows. Raises ValueError where there is no node or effect of that name.
        """
        if name in self.nodes:
            others = {other: node for other, node in self.nodes.items() if other != name}
            return self.with_nodes(others or {name: _emptied(self.nodes[name])})
        if name not in self.effects:
            known = ", ".join([*self.nodes, *self.effects])
            raise ValueError(f"the scene has no node or effect {name!r} to leave out: choose one of {known}")
        effects = dict(self.effects.items()) | {name: self.effects[name].settings.left_out()}
        return self._like(dict(self.nodes.items()), {key: one for key, one in effects.items() if one is not None})

    def with_nodes(self, nodes: Mapping[str, Node]) -> "SceneGraph":
        """Other nodes seen through the same effects."""
        return self._like(nodes, dict(self.effects.items()))

    def _like(self, nodes: Mapping[str, Node], effects: Mapping[str, Effect]) -> "SceneGraph":
        return SceneGraph(nodes, effects)


def _emptied(node: Node) -> Node:
    empty = copy.deepcopy(node)
    empty.mask = None
    empty.rows.resize(RowPlan.keep(torch.zeros(len(node.rows), dtype=torch.bool, device=node.rows.means.device)))
    return empty
