"""The scene graph: nodes by name, one list of Gaussians in a view."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sparsestreet.ops.activate import activate
from sparsestreet.ops.raw import RawGaussians
from sparsestreet.scene.learning_rate import LearningRate, matching_rate
from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, Node
from sparsestreet.scene.sky import Sky
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


class SceneGraph(nn.Module):
    """Nodes by name, and the sky behind them. Raises ValueError without any node."""

    def __init__(self, nodes: Mapping[str, Node], sky: Sky | None = None) -> None:
        super().__init__()
        if not nodes:
            raise ValueError("a scene needs at least one node, got none: add a background")
        # A ModuleDict's values are any modules to a type checker.
        self.nodes = cast("Mapping[str, Node]", nn.ModuleDict(nodes))
        self.sky = sky

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    def gaussians_at(self, view: View, state: SceneState = FINISHED) -> SceneGaussians:
        """Activated Gaussians of all nodes in the world, seen from a view."""
        parts = {name: node.raw_at(view, state) for name, node in self.nodes.items()}
        spans, start = {}, 0
        for name, part in parts.items():
            spans[name] = slice(start, start + len(part))
            start += len(part)
        return SceneGaussians(activate(list(parts.values()), sh_degree=state.sh_degree), spans, parts)

    def counts(self) -> dict[str, int]:
        """Number of rows of every node, absent instances included."""
        return {name: len(node.rows) for name, node in self.nodes.items()}

    def regularizers(
        self, parts: Mapping[str, RawGaussians], drawn: Mapping[str, Bool[Tensor, " _"]], state: SceneState
    ) -> dict[str, Float[Tensor, ""]]:
        """The weighted terms of all nodes, named node/term.

        ``parts`` is what they answered for the view, ``drawn`` which of their rows it shows.
        """
        return {
            f"{name}/{term}": value
            for name, node in self.nodes.items()
            for term, value in node.regularizers(parts[name], drawn[name], state).items()
        }

    def learning_rates(self) -> dict[str, LearningRate]:
        """Dotted name of every parameter -> its rate. Raises ValueError, naming where to add it, for a missing one."""
        rates = {}
        for name, node in self.nodes.items():
            for parameter, _ in node.named_parameters():
                where = f"node.{name}.learning_rates"
                rates[f"nodes.{name}.{parameter}"] = matching_rate(parameter, node.settings.learning_rates, where)
        if self.sky is not None:
            rates["sky.texels"] = self.sky.settings.learning_rate
        return rates

    def bytes_by_part(self) -> dict[str, int]:
        """float32 bytes of what has to be stored: every node's rows (no masks), ``poses``, ``sky``."""
        parts = {name: node.row_bytes() for name, node in self.nodes.items()}
        parts["poses"] = sum(node.pose_bytes() for node in self.nodes.values())
        parts["sky"] = 0 if self.sky is None else BYTES_PER_NUMBER * self.sky.texels.numel()
        return parts
