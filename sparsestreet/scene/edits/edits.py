"""Edits of a scene as values: what is hidden, goes another way, or is there once more. Its file stays as it is."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from sparsestreet.scene.edits.nodes import ALWAYS, AddedObject, Change, EditedNode, recorded_frames
from sparsestreet.scene.edits.paths import AsRecorded, Frame, Held, Recorded
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.nodes.rigid import Rigid
from sparsestreet.scene.nodes.tracked import Tracked

REMOVED = Change(hidden=(ALWAYS,))


@dataclass(frozen=True)
class Added:
    """An object once more, or one of another scene."""

    of: str
    """Name of the object."""
    change: Change = field(default_factory=lambda: Change(AsRecorded()))
    """Its way and when it is hidden. A way that refers to what was recorded starts from ``instead_of``, else from its
    own recorded way; that of an object of another scene means nothing here."""
    instead_of: str | None = None
    """An object of the edited scene whose way it takes, standing on the same ground."""
    scene: SceneGraph | None = None
    """The other scene; None: the edited one."""
    speed: float = 1.0
    """Normalized time of the other scene that passes in one of this scene."""


@dataclass(frozen=True)
class Edits:
    """What becomes of a scene's objects, by the names of their tracks.

    >>> Edits(changes={"car": REMOVED}).changes["car"].shows(0.5, recorded=True)
    False
    """

    changes: Mapping[str, Change] = field(default_factory=dict)
    added: Mapping[str, Added] = field(default_factory=dict)
    """Name of the new object -> what it is."""


def edited(scene: SceneGraph, edits: Edits) -> SceneGraph:
    """The scene with these edits, made of the same tensors; the scene itself stays as it is.

    Raises ValueError for an object that the scene has not, or a new one of a name that is taken.
    """
    changes = {objects_of(scene, name): change for name, change in edits.changes.items()}
    added = {name: _added(scene, name, one) for name, one in edits.added.items()}
    in_place: dict[str, dict[int, Change]] = {}
    for (node_name, instance), change in changes.items():
        node = scene.nodes[node_name]
        assert isinstance(node, Tracked), "objects are those of tracked nodes"
        if isinstance(change.path, Held) and not isinstance(node, Rigid):
            # Its shape is held too, and a node has one time for all of its objects.
            name, recorded = node.names[instance], recorded_frames(node, instance)
            added[name] = AddedObject(node, instance, change, recorded, to_source=float)
            change = REMOVED
        in_place.setdefault(node_name, {})[instance] = change
    nodes: dict[str, Node] = {}
    for name, node in scene.nodes.items():
        nodes[name] = EditedNode(node, in_place[name]) if name in in_place and isinstance(node, Tracked) else node
    if taken := nodes.keys() & added.keys():
        raise ValueError(f"a node of the scene is named {min(taken)!r}: give the new object another name")
    return scene.with_nodes(nodes | added).eval()


def objects_of(scene: SceneGraph, name: str) -> tuple[str, int]:
    """The node that has an object, and the object's number there. Raises ValueError, with the nearest names."""
    names = {}
    for node_name, node in scene.nodes.items():
        found = node.instances()
        names |= {} if found is None else {one: (node_name, number) for number, one in enumerate(found.names)}
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.3) or list(names)[:3]
        said = f"the nearest names are {', '.join(near)}" if names else "it has no objects at all"
        raise ValueError(f"the scene has no object {name!r}: {said} (sparsestreet objects RUN lists all)")
    return names[name]


def _added(scene: SceneGraph, name: str, one: Added) -> AddedObject:
    source, instance = _object(one.scene or scene, one.of)
    taken = [other for node in scene.nodes.values() if (found := node.instances()) for other in found.names]
    if name in taken:
        raise ValueError(f"the scene has an object {name!r} already: give the new one another name")
    change = one.change if one.change.path is not None else replace(one.change, path=AsRecorded())
    recorded = recorded_frames(source, instance)
    if one.instead_of is not None:
        recorded = _on_the_same_ground(source, instance, *_object(scene, one.instead_of))
    elif one.scene is not None and isinstance(change.path, AsRecorded):
        raise ValueError(f"{name!r} comes from another scene, where its recorded way belongs: give it a way of its own")
    return AddedObject(source, instance, change, recorded, to_source=lambda time: one.speed * time)


def _on_the_same_ground(source: Tracked, instance: int, other: Tracked, other_instance: int) -> Recorded:
    """The recorded way of another object, for one of another height: both stand on the same ground."""
    way = recorded_frames(other, other_instance)
    lift = source.frame_height(instance) - other.frame_height(other_instance)

    def at(time: float) -> Frame:
        frame = way(time).copy()
        frame[:3, 3] += lift * frame[:3, 2]
        return frame

    return at


def _object(scene: SceneGraph, name: str) -> tuple[Tracked, int]:
    node_name, instance = objects_of(scene, name)
    node = scene.nodes[node_name]
    assert isinstance(node, Tracked), "objects are those of tracked nodes"
    return node, instance
