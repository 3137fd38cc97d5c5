"""Assigns each object to a node, once, before any node is built."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sparsestreet.scene.nodes.node import NodeSettings
from sparsestreet.types import Track


@dataclass(frozen=True)
class Assignment:
    """The tracks of each node; every track of a log belongs to at most one node."""

    by_node: dict[str, tuple[Track, ...]]
    unclaimed: tuple[Track, ...]
    """Objects that no node takes; they become part of the static scene."""

    @property
    def claimed(self) -> tuple[Track, ...]:
        """The objects of all nodes, in the order of the nodes."""
        return tuple(track for tracks in self.by_node.values() for track in tracks)


def assign_tracks(tracks: Sequence[Track], nodes: Mapping[str, NodeSettings]) -> Assignment:
    """Gives each track to the node that takes it. Raises ValueError naming the nodes if two claim one track."""
    by_node: dict[str, list[Track]] = {name: [] for name in nodes}
    unclaimed = []
    for track in tracks:
        takers = [name for name, settings in nodes.items() if settings.takes(track)]
        if len(takers) > 1:
            raise ValueError(
                f"track {track.name!r} ({track.class_name}) can belong to one node only, but {' and '.join(takers)} "
                f"claim it: take {track.class_name!r} out of one of node.{takers[0]}.classes, node.{takers[1]}.classes"
            )
        if takers:
            by_node[takers[0]].append(track)
        else:
            unclaimed.append(track)
    return Assignment({name: tuple(taken) for name, taken in by_node.items()}, tuple(unclaimed))
