"""Edits of a scene as values: what is hidden, goes another way, or is there once more. Its file stays as it is."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from sparsestreet.naming import nearest, one_line
from sparsestreet.scene.edits.ground import Ground
from sparsestreet.scene.edits.nodes import ALWAYS, AddedObject, Change, EditedNode, recorded_frames
from sparsestreet.scene.edits.paths import AsRecorded, Driven, Frame, Held, Moved, Recorded
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.nodes.node import Node
from sparsestreet.scene.nodes.tracked import Rigid, Tracked

Object = tuple[str, Tracked, int]
"""Name of a node, the node, and the number of one of its objects."""

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
    objects = objects_of(scene)
    added = {name: _added(scene, objects, name, one) for name, one in edits.added.items()}
    in_place: dict[str, dict[int, Change]] = {}
    for name, change in edits.changes.items():
        node_name, node, instance = found(objects, name)
        if isinstance(change.path, Held) and not isinstance(node, Rigid):
            # Its shape is held too, and a node has one time for all of its objects.
            added[name] = AddedObject(name, node, instance, change, recorded_frames(node, instance), to_source=float)
            change = REMOVED
        in_place.setdefault(node_name, {})[instance] = change
    nodes: dict[str, Node] = {}
    for name, node in scene.nodes.items():
        nodes[name] = EditedNode(node, in_place[name]) if name in in_place and isinstance(node, Tracked) else node
    if taken := nodes.keys() & added.keys():
        raise ValueError(f"a node of the scene is named {min(taken)!r}: give the new object another name")
    # A module's name has no dots; an object's may.
    return scene.with_nodes(nodes | {name.replace(".", "_"): node for name, node in added.items()}).eval()


def objects_of(scene: SceneGraph) -> dict[str, Object]:
    """The objects that can be edited, by the names of their tracks."""
    return {
        name: (node_name, node, number)
        for node_name, node in scene.nodes.items()
        if isinstance(node, Tracked)
        for number, name in enumerate(node.names)
    }


def found(objects: Mapping[str, Object], name: str) -> Object:
    """The object of a name. Raises ValueError, with the nearest names, where there is none."""
    if name not in objects:
        near = map(one_line, nearest(name, objects, most=3, cutoff=0.3) or list(objects)[:3])
        said = f"the nearest names are {', '.join(near)}" if objects else "it has no objects that move at all"
        raise ValueError(f"the scene has no object {one_line(name)!r}: {said} (sparsestreet objects RUN lists all)")
    return objects[name]


def _added(scene: SceneGraph, objects: Mapping[str, Object], name: str, one: Added) -> AddedObject:
    if name in objects:
        raise ValueError(f"the scene has an object {name!r} already: give the new one another name")
    try:
        _, source, instance = found(objects if one.scene is None else objects_of(one.scene), one.of)
    except ValueError as error:
        raise ValueError(f"{name!r} is made of another object: {error}") from error
    change = one.change if one.change.path is not None else replace(one.change, path=AsRecorded())
    if one.scene is not None and isinstance(change.path, Driven) and change.path.heights is None:
        change = replace(change, path=_on_the_ground(scene, name, change.path, source.frame_height(instance)))
    recorded = recorded_frames(source, instance)
    if one.instead_of is not None:
        recorded = _on_the_same_ground(source, instance, *found(objects, one.instead_of)[1:])
    elif one.scene is not None and isinstance(change.path, AsRecorded | Moved | Held):
        raise ValueError(f"{name!r} comes from another scene, where its recorded way belongs: give it a way of its own")
    return AddedObject(name, source, instance, change, recorded, to_source=lambda time: one.speed * time)


def off_the_ground(scene: SceneGraph, edits: Edits) -> dict[str, float]:
    """Return how far objects on ways of their own stand above the ground (below: negative), where most; meters.

    Left out are those for which nobody knows.
    """
    ground = Ground(scene)
    objects = objects_of(scene)
    ways = {name: (found(objects, name), change.path) for name, change in edits.changes.items()}
    for name, one in edits.added.items():
        ways[name] = found(objects if one.scene is None else objects_of(one.scene), one.of), one.change.path
        if one.scene is not None and isinstance(one.change.path, Driven) and one.change.path.heights is None:
            del ways[name]  # it is set on the ground
    off: dict[str, float] = {}
    for name, ((_, node, instance), path) in ways.items():
        if isinstance(path, Driven):
            recorded = recorded_frames(node, instance)
            places = [path.frame(time, recorded)[:3, 3].tolist() for time in path.times]
            heights = [ground.off(x, y, z - node.frame_height(instance)) for x, y, z in places]
            heights = [off for off in heights if off is not None]
            off |= {name: max(heights, key=abs)} if heights else {}
    return off


def _on_the_ground(scene: SceneGraph, name: str, path: Driven, height: float) -> Driven:
    ground = Ground(scene)
    grounds = [ground.below(x, y) for x, y in path.positions]
    if missing := [place for place, below in zip(path.positions, grounds, strict=True) if below is None]:
        raise ValueError(f"nothing stands still within 8 m of {missing[0]}, where {name!r} goes: say z in its path")
    return replace(path, heights=[height + below for below in grounds if below is not None])


def _on_the_same_ground(source: Tracked, instance: int, other: Tracked, other_instance: int) -> Recorded:
    """The recorded way of another object, for one of another height: both stand on the same ground."""
    way = recorded_frames(other, other_instance)
    lift = source.frame_height(instance) - other.frame_height(other_instance)

    def at(time: float) -> Frame:
        frame = way(time).copy()
        frame[:3, 3] += lift * frame[:3, 2]
        return frame

    return at
