"""The scene graph: nodes by name, one list of Gaussians at a time."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from sparsestreet.scene.nodes.node import BYTES_PER_NUMBER, MaskTerm, Node
from sparsestreet.scene.sky import Sky
from sparsestreet.types import Gaussians


@dataclass(frozen=True)
class SceneGaussians:
    """All nodes' Gaussians at a time, in the order of the nodes."""

    gaussians: Gaussians
    rows: dict[str, slice]
    """Name of a node -> its rows in ``gaussians``."""


class SceneGraph(nn.Module):
    """Nodes by name, and the sky behind them. ``active_sh_degree`` is what training raises step by step."""

    def __init__(self, nodes: Mapping[str, Node], sky: Sky | None = None, active_sh_degree: int = 3) -> None:
        super().__init__()
        if not nodes:
            raise ValueError("a scene needs at least one node, got none: add a background")
        self.nodes = nn.ModuleDict(nodes)
        self.sky = sky
        self.active_sh_degree = active_sh_degree

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    def gaussians_at(self, time: float) -> SceneGaussians:
        """Activated Gaussians of all nodes in the world at a normalized time."""
        parts, rows, start = [], {}, 0
        for name, node in self.nodes.items():
            part = node.gaussians_at(time, self.active_sh_degree)
            parts.append(part)
            rows[name] = slice(start, start + len(part))
            start += len(part)
        return SceneGaussians(Gaussians.concatenate(parts), rows)

    def counts(self) -> dict[str, int]:
        """Number of rows of every node, absent instances included."""
        return {name: len(node.rows) for name, node in self.nodes.items()}

    def mask_terms(self) -> dict[str, MaskTerm]:
        """Scores and weight of every node that is being masked."""
        scores = {name: node.mask_scores() for name, node in self.nodes.items()}
        return {
            name: MaskTerm(value, self.nodes[name].mask.weight, self.nodes[name].mask.visible_only)
            for name, value in scores.items()
            if value is not None
        }

    def bytes_by_part(self) -> dict[str, int]:
        """float32 bytes of what has to be stored: every node's rows (no masks), ``poses``, ``sky``."""
        parts = {name: node.row_bytes() for name, node in self.nodes.items()}
        parts["poses"] = sum(node.pose_bytes() for node in self.nodes.values())
        parts["sky"] = 0 if self.sky is None else BYTES_PER_NUMBER * self.sky.texels.numel()
        return parts
