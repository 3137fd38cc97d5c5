"""Edits of a street that was traced: what the scene shows beside the street traced with the same edit.

An object is removed, moved 3 m to its right, or copied 3 m to its right. The region are the pixels that the edit
changes in the traced images. A ghost is what is left of an object where it was: the part of the error that looks like
the object, by projection, and its energy as a share of the object's. Of what is moved or copied, the error is split
into that of the object's pixels where it is now, of its outline, and of all else: its shadow, and where it was.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation, binary_erosion
from torch import Tensor

from sparsestreet.bench.records import RecordFile
from sparsestreet.data.log import Truth
from sparsestreet.data.synthetic.motion import Way
from sparsestreet.data.synthetic.parts import Pose, at
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.truth import street_truth
from sparsestreet.data.synthetic.world import Actor, World, build_world
from sparsestreet.scene.edits import REMOVED, Added, Change, Edits, Moved, edited
from sparsestreet.scene.edits.edits import objects_of
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

Show = Callable[[View], Float64[np.ndarray, "h w 3"]]
"""The image of a view, RGB in [0, 1]."""

Covers = Callable[[View], Bool[np.ndarray, "h w"]]
"""The pixels of a view that an object covers."""

RIGHT = 3.0
"""Meters."""
LEAST = 200
"""Pixels that an edit must change for a view to count."""
VIEWS = 6
"""Views of each edit, those where it changes most of a spread of views."""
KINDS = ("removed", "moved", "copied")


@dataclass(frozen=True)
class Beside(Way):
    """An actor's path, moved to its right."""

    path: Way
    right: float

    def traveled(self, time: float) -> float:
        return self.path.traveled(time)

    def pose(self, time: float, height: float) -> Pose:
        return self.path.pose(time, height) @ at(0.0, -self.right, 0.0)


@dataclass(frozen=True)
class EditRecord:
    """One edit of one object."""

    edit: str
    object: str
    class_name: str
    views: int
    pixels: int
    """That the edit changes, in all of these views."""
    psnr: float
    """In that region, of the edited scene beside the street traced with the edit, dB."""
    psnr_before: float
    """In the same region, of the scene beside the street as they were, dB."""
    ghost: float | None
    """Energy of what is left of the object, as a share of its own; None: nothing was taken away."""
    inside: float | None = None
    """Share of the squared error in pixels that the object covers where it is now; None: it is nowhere."""
    outline: float | None = None
    """In pixels on either side of its outline, which count in no other share; the rest is shadow, and where it was."""


@torch.no_grad()
def run_edits(
    stored: StoredScene,
    views: Sequence[View],
    settings: StreetSettings,
    street_from_world: Float64[Tensor, "4 4"],
    file: RecordFile,
    say: Callable[[str], None] = print,
) -> int:
    """Measures three edits of each object that is seen; returns the number of records."""
    world, count = build_world(settings), 0
    truth = street_truth(settings, street_from_world)
    for name, actor, place in actors_of(stored, world, settings, street_from_world):
        for kind in KINDS:
            edits, actors = _edit(kind, name, actor, list(world.actors), place)
            other = street_truth(settings, street_from_world, replace(world, actors=tuple(actors)))
            scene = replace(stored, scene=edited(stored.scene, edits))
            shown = (partial(shown_by, stored), partial(shown_by, scene))
            alone = None if kind == "removed" else covered_by(_beside(actor), world, settings, street_from_world)
            record = compared(kind, name, actor, shown, views, (truth, other), alone)
            if record is not None:
                file.write("edit", record)
                say(in_words(record))
                count += 1
    return count


def in_words(record: EditRecord) -> str:
    ghost = "" if record.ghost is None else f", ghost {100 * record.ghost:.2f} %"
    return (
        f"{record.edit:8} {record.object:16} {record.class_name:10} {record.psnr:5.1f} dB in {record.pixels:,} pixels "
        f"of {record.views} views (unedited {record.psnr_before:.1f}){ghost}{_shares(record)}"
    )


def _shares(record: EditRecord) -> str:
    if record.inside is None or record.outline is None:
        return ""
    rest = 1 - record.inside - record.outline
    return f", of the error {record.inside:.0%} inside, {record.outline:.0%} outline, {rest:.0%} elsewhere"


def _edit(kind: str, name: str, actor: Actor, actors: list[Actor], place: int) -> tuple[Edits, list[Actor]]:
    beside = _beside(actor)
    if kind == "removed":
        return Edits({name: REMOVED}), [*actors[:place], *actors[place + 1 :]]
    if kind == "moved":
        return Edits({name: Change(Moved(right=RIGHT))}), [*actors[:place], beside, *actors[place + 1 :]]
    return Edits(added={"copy": Added(name, Change(Moved(right=RIGHT)))}), [*actors, beside]


def _beside(actor: Actor) -> Actor:
    return replace(actor, path=Beside(actor.path, RIGHT))


def covered_by(
    actor: Actor, world: World, settings: StreetSettings, street_from_world: Float64[Tensor, "4 4"]
) -> Covers:
    """The pixels of an actor: those that show no sky where nothing else is in the world."""
    truth = street_truth(settings, street_from_world, replace(world, scenery=(), actors=(actor,)))

    def covers(view: View) -> Bool[np.ndarray, "h w"]:
        frame = truth(view)
        if frame is None or frame.sky is None:
            raise ValueError(f"the camera stands in {actor.name}: give a view that shows the street")
        return ~frame.sky.numpy()

    return covers


def compared(
    kind: str,
    name: str,
    actor: Actor,
    shown: tuple[Show, Show],
    views: Sequence[View],
    truths: tuple[Truth, Truth],
    covers: Covers | None = None,
) -> EditRecord | None:
    """What is shown without and with an edit, beside the street traced without and with it.

    ``covers`` says which pixels the object covers after the edit; None: it is nowhere. None is returned where the edit
    changes too little in every view.
    """
    found = []
    for view in views:
        before, after = (truth(view) for truth in truths)
        if before is None or after is None:
            continue
        pair = [frame.image.double().numpy() / 255 for frame in (before, after)]
        changed = np.abs(pair[0] - pair[1]).max(-1) > 3 / 255
        if changed.sum() >= LEAST:
            found.append((int(changed.sum()), view, pair, changed))
    found = sorted(found, key=lambda one: -one[0])[:VIEWS]
    if not found:
        return None
    errors, old_errors, alike, own = 0.0, 0.0, 0.0, 0.0
    inside, outline = 0.0, 0.0
    for _, view, (before, after), changed in found:
        error = (shown[1](view) - after)[changed]
        if covers is not None:
            covered = covers(view)
            border = np.not_equal(binary_dilation(covered), binary_erosion(covered, border_value=1))
            inside += float((error[(covered & ~border)[changed]] ** 2).sum())
            outline += float((error[border[changed]] ** 2).sum())
        thing = (before - after)[changed]
        errors += float((error**2).sum())
        old_errors += float(((shown[0](view) - before)[changed] ** 2).sum())
        alike += float((error * thing).sum())
        own += float((thing**2).sum())
    pixels = sum(one[0] for one in found)
    ghost = (max(alike, 0.0) / own) ** 2 if kind == "removed" else None
    return EditRecord(
        kind,
        name,
        actor.model.class_name,
        len(found),
        pixels,
        _db(errors, pixels),
        _db(old_errors, pixels),
        ghost,
        None if covers is None else inside / max(errors, 1e-12),
        None if covers is None else outline / max(errors, 1e-12),
    )


def shown_by(stored: StoredScene, view: View) -> Float64[np.ndarray, "h w 3"]:
    """The image of a scene, RGB in [0, 1]."""
    return stored.render(view).rgb.clamp(0, 1).double().cpu().numpy()


def _db(squared: float, pixels: int) -> float:
    return float(-10 * np.log10(squared / (3 * pixels)))


def actors_of(
    stored: StoredScene, world: World, settings: StreetSettings, street_from_world: Float64[Tensor, "4 4"]
) -> Iterator[tuple[str, Actor, int]]:
    """Yields the objects of the scene with the actors that they are: those whose paths are the nearest."""
    first, last = settings.recorded
    times = np.linspace(0.0, 1.0, 9)
    for name, (_, node, instance) in objects_of(stored.scene).items():
        start, end = node.spans[instance].tolist()
        own = [time for time in times if start <= time <= end] or [(start + end) / 2]
        moment = own[len(own) // 2]
        frame = node.object_frames(node.pose_at(float(moment)))[instance]
        place = street_from_world.numpy() @ np.append(frame[:3, 3], 1.0)
        seconds = first + float(moment) * (last - first)
        gaps = [float(np.linalg.norm(actor.pose(seconds)[:2, 3] - place[:2])) for actor in world.actors]
        nearest = int(np.argmin(gaps))
        if gaps[nearest] < 1.0:
            yield name, world.actors[nearest], nearest
