"""A scene with something left out: what is left is the same modules, and copies only of what has to change."""

import copy

import torch

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Node


def without_node(scene: SceneGraph, name: str) -> SceneGraph:
    """The scene without a node; a lone node stays, without rows."""
    others = {other: node for other, node in scene.nodes.items() if other != name}
    return SceneGraph(others or {name: _emptied(scene.nodes[name])}, scene.sky)


def without_sky(scene: SceneGraph) -> SceneGraph:
    """The scene before black."""
    return SceneGraph(dict(scene.nodes.items()))


def has_masks(scene: SceneGraph) -> bool:
    """Whether any node still has a mask."""
    return any(node.mask is not None for node in scene.nodes.values())


def without_masks(scene: SceneGraph) -> SceneGraph:
    """The scene with every row shown at all times."""
    return SceneGraph({name: _unmasked(node) for name, node in scene.nodes.items()}, scene.sky)


def without_closed_rows(scene: SceneGraph, time: float) -> SceneGraph:
    """The scene as it is at a normalized time, without the rows that masks close then, and without the masks."""
    nodes = {}
    for name, node in scene.nodes.items():
        nodes[name] = _unmasked(node)
        if node.mask is not None:
            nodes[name].rows.resize(RowPlan.keep(node.mask.multipliers(node.rows, time) > 0))
    return SceneGraph(nodes, scene.sky)


def _unmasked(node: Node) -> Node:
    if node.mask is None:
        return node
    bare = copy.deepcopy(node)
    bare.mask = None
    return bare


def _emptied(node: Node) -> Node:
    empty = copy.deepcopy(node)
    empty.mask = None
    empty.rows.resize(RowPlan.keep(torch.zeros(len(node.rows), dtype=torch.bool, device=node.rows.means.device)))
    return empty
