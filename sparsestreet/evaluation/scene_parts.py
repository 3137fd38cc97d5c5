"""A scene without its masks: what stays is the same modules, and copies only of what has to change.

Nodes and effects are left out by ``SceneGraph.without``.
"""

import copy

from sparsestreet.scene.gaussians import RowPlan
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes import Node


def has_masks(scene: SceneGraph) -> bool:
    """Whether any node still has a mask."""
    return any(node.mask is not None for node in scene.nodes.values())


def without_masks(scene: SceneGraph) -> SceneGraph:
    """The scene with every row shown at all times."""
    return scene.with_nodes({name: _unmasked(node) for name, node in scene.nodes.items()})


def without_closed_rows(scene: SceneGraph, time: float) -> SceneGraph:
    """The scene as it is at a normalized time, without the rows that masks close then, and without the masks."""
    nodes = {}
    for name, node in scene.nodes.items():
        nodes[name] = _unmasked(node)
        if node.mask is not None:
            nodes[name].rows.resize(RowPlan.keep(node.mask.multipliers(node.rows, time) > 0))
    return scene.with_nodes(nodes)


def _unmasked(node: Node) -> Node:
    if node.mask is None:
        return node
    bare = copy.deepcopy(node)
    bare.mask = None
    return bare
