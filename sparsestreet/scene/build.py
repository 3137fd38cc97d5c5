"""From a driving log to a scene graph ready for training."""

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sparsestreet.data.lazy import Frames
from sparsestreet.data.log import DrivingLog
from sparsestreet.geometry.boxes import without_frames
from sparsestreet.phases import stage
from sparsestreet.scene.effects import Effect
from sparsestreet.scene.effects.effect import EffectPlan, PlannedEffect
from sparsestreet.scene.generators import named_generator
from sparsestreet.scene.graph import SceneGraph
from sparsestreet.scene.initialize.training_data import TrainingData
from sparsestreet.scene.nodes.node import Node, NodeSettings
from sparsestreet.triangulation import ImagePointSettings, StreetPoints, kept_street_points
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
    """Give each track to the node that takes it. Raises ValueError naming the nodes if two claim one track."""
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


_log = logging.getLogger(__name__)


def find_points(
    log: DrivingLog,
    train_frames: Frames,
    held_out: frozenset[int],
    nodes: Mapping[str, NodeSettings],
    settings: ImagePointSettings | None,
) -> StreetPoints | None:
    """Return points from the training images, those of an earlier run if it kept them; None without settings."""
    if settings is None:
        return None
    moving = without_frames(assign_tracks(log.tracks, nodes).claimed, held_out)
    with stage("points"):
        return kept_street_points(log.kept, train_frames, moving, settings)


def build_scene(
    log: DrivingLog,
    train_frames: Frames,
    held_out: frozenset[int],
    nodes: Mapping[str, NodeSettings],
    plan: EffectPlan,
    seed: int,
    points: StreetPoints | None = None,
) -> SceneGraph:
    """Start every node class from what training may see.

    Args:
        log: the drive.
        train_frames: views that random points are placed in and colored by.
        held_out: integer frames whose sweeps and boxes must not be used.
        nodes: name of the node class -> what is said about it. A class without any instance is left out, and the
            program's log says so.
        plan: which effects the scene is seen through. The program's log says why.
        seed: each node and effect draws from its own stream, so a change of one leaves the others as they are.
        points: of the views (``find_points``); None: no node gets any.

    Raises ValueError where two nodes claim one track, or a node has nothing to start from.
    """
    assignment = assign_tracks(log.tracks, nodes)
    _report(assignment)
    moving = without_frames(assignment.claimed, held_out)
    built: dict[str, Node] = {}
    for name, settings in nodes.items():
        data = TrainingData(log, train_frames, held_out, assignment.by_node[name], moving, points)
        node = settings.build(data, named_generator(seed, name))
        if node is None:
            _log.warning("node %r has no instance in %s: the scene goes without it", name, log.name)
        else:
            _log.info("node %r starts with %d Gaussians", name, len(node.rows))
            built[name] = node
    for planned in plan.effects:
        planned.settings.prepare(built.values(), planned.on)
    return SceneGraph(built, _effects(plan, TrainingData(log, train_frames, held_out), seed))


def _effects(plan: EffectPlan, data: TrainingData, seed: int) -> dict[str, Effect]:
    """Those that are on; what stands in the place of one that is off."""
    built: dict[str, Effect | None] = {}
    for planned in plan.effects:
        name, settings = planned.name, planned.settings
        if planned.on:
            built[name] = settings.build(data, planned.finding, named_generator(seed, name))
        elif settings.when == "off" or planned.finding.value:  # it is in the cameras, and is taken from them
            built[name] = settings.left_out()
        if planned.on or planned.only_found:
            _log.info("effect %r is %s: %s", name, _word(planned), planned.finding.reason)
    if rest := [planned.name for planned in plan.effects if not (planned.on or planned.only_found)]:
        _log.info("effects that are not on: %s (sparsestreet effects says why)", ", ".join(rest))
    return {name: effect for name, effect in built.items() if effect is not None}


def _word(planned: PlannedEffect) -> str:
    return "found, not simulated" if not planned.on else "on" if planned.settings.when == "auto" else "forced on"


def _report(assignment: Assignment) -> None:
    """What becomes of the objects of the log."""
    for name, tracks in assignment.by_node.items():
        if tracks:
            _log.info("node %r takes %s", name, _by_class(tracks))
    if assignment.unclaimed:
        _log.info("no node takes %s: they are part of the background", _by_class(assignment.unclaimed))


def _by_class(tracks: Sequence[Track]) -> str:
    """As "3 Vehicle, 1 Cyclist"."""
    return ", ".join(f"{count} {name}" for name, count in Counter(track.class_name for track in tracks).items())
