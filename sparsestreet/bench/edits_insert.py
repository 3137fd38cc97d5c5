"""Objects of another trained street, inserted where they were in their own: beside the street traced with them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.bench.edits import actors_of, compared, covered_by, in_words, shown_by
from sparsestreet.bench.records import RecordFile
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.truth import street_truth
from sparsestreet.data.synthetic.world import Actor, World, build_world
from sparsestreet.scene.edits import Added, Change, Driven, Edits, edited
from sparsestreet.scene.edits.edits import objects_of
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

PLACES = 40
"""Of a way: straight between them."""


@dataclass(frozen=True)
class TracedStreet:
    """A trained street and how it is traced."""

    stored: StoredScene
    settings: StreetSettings
    street_from_world: Float64[Tensor, "4 4"]


@torch.no_grad()
def run_inserts(
    street: TracedStreet,
    other: TracedStreet,
    views: Sequence[View],
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> int:
    """Inserts each object of the other street on its own way; returns the number of records.

    It keeps the light of its own street, which the truth does not: a street's weather follows from its seed. Only views
    count at times at which its own log shows it, and at which it stands in no other. Raises ValueError for logs of two
    lengths.
    """
    if street.settings.recorded != other.settings.recorded:
        raise ValueError(
            f"both logs must last as long, got {street.settings.recorded} and {other.settings.recorded} seconds"
        )
    world, foreign, count = build_world(street.settings), build_world(other.settings), 0
    truth = street_truth(street.settings, street.street_from_world)
    taken = set(objects_of(street.stored.scene))
    for name, actor, _ in actors_of(other.stored, foreign, other.settings, other.street_from_world):
        new = f"{name} of the other" if name in taken else name
        added = Added(name, Change(_way(street, other, name, actor)), scene=other.stored.scene)
        scene = replace(street.stored, scene=edited(street.stored.scene, Edits(added={new: added})))
        with_it = street_truth(street.settings, street.street_from_world, replace(world, actors=(*world.actors, actor)))
        start, end = _span(other, name)
        own = [view for view in views if start <= view.time <= end and _is_free(street, world, actor, view.time)]
        shown = (partial(shown_by, street.stored), partial(shown_by, scene))
        covers = covered_by(actor, world, street.settings, street.street_from_world)
        record = compared("inserted", name, actor, shown, own, (truth, with_it), covers)
        if record is not None:
            file.write("insert", record)
            say(in_words(record))
            count += 1
    return count


def _is_free(street: TracedStreet, world: World, actor: Actor, time: float) -> bool:
    """Whether no actor of the street is as near as the halves of both of their lengths."""
    first, last = street.settings.recorded
    place = actor.pose(first + time * (last - first))[:2, 3]
    others = ((one, one.pose(first + time * (last - first))[:2, 3]) for one in world.actors)
    return all(
        float(np.linalg.norm(place - there)) > (actor.model.size[0] + one.model.size[0]) / 2 for one, there in others
    )


def _span(street: TracedStreet, name: str) -> tuple[float, float]:
    _, node, instance = objects_of(street.stored.scene)[name]
    start, end = node.spans[instance].tolist()
    return start, end


def _way(street: TracedStreet, other: TracedStreet, name: str, actor: Actor) -> Driven:
    """The actor's own way through the street, of the frame that the trained object has."""
    first, last = other.settings.recorded
    start, end = _span(other, name)
    moment = (start + end) / 2
    _, node, instance = objects_of(other.stored.scene)[name]
    trained = other.street_from_world.numpy() @ np.asarray(node.object_frames(node.pose_at(moment))[instance])
    # A person's frame is at the pelvis, an actor's in the middle of its box.
    lift = trained[2, 3] - actor.pose(first + moment * (last - first))[2, 3]
    world_from_street = np.linalg.inv(street.street_from_world.numpy())
    times = np.linspace(0.0, 1.0, PLACES).tolist()
    poses = [world_from_street @ actor.pose(first + time * (last - first)) for time in times]
    return Driven(
        times,
        [(float(pose[0, 3]), float(pose[1, 3])) for pose in poses],
        [float(pose[2, 3] + lift) for pose in poses],
        [float(np.arctan2(pose[1, 0], pose[0, 0])) for pose in poses],
    )
