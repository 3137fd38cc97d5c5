"""Edit objects of trained streets, beside the street traced so: ``python -m benchmarks.edited_objects``.

An object is removed, moved 2 m to its right, or copied there. What counts are the pixels that the edit changes in the
traced images. A ghost is what is left of an object where it was: the part of the error that looks like the object, by
projection, and its energy as a share of the object's.
"""

import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64

from sparsestreet.bench.records import RecordFile
from sparsestreet.cli.commands.bench import record_file
from sparsestreet.cli.commands.options import run_command
from sparsestreet.cli.commands.scenes import open_scene, recorded_views
from sparsestreet.cli.config.log_from_options import reader_of
from sparsestreet.cli.config.targets import open_run_config
from sparsestreet.data.synthetic import StreetReader
from sparsestreet.data.synthetic.reader import street_truth
from sparsestreet.data.synthetic.settings import StreetSettings
from sparsestreet.data.synthetic.tracer import Pose, at
from sparsestreet.data.synthetic.world import Way, World, build_world
from sparsestreet.scene.edits import REMOVED, Added, Change, Edits, Moved, edited
from sparsestreet.scene.edits.edits import objects_of
from sparsestreet.scene.edits.nodes import recorded_frames
from sparsestreet.scene.storage import StoredScene
from sparsestreet.types import View

RIGHT = 2.0
"""Meters. At 3 m the cyclists of embedded streets ride in the curb, which hides their wheels or does not, by a hair."""
LEAST = 100
"""Pixels that an edit must change for a view to count."""
VIEWS = 4
"""Views of each edit, those where it changes most."""
VISIBLE = 3 / 255
"""Difference of a pixel that the edit changes."""
NEAR = 1.5
"""Meters in plan between an object and the actor that it is, most: an end that nobody saw is a guess."""
EDITS = ("removed", "moved", "copied")
Image = Float64[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Beside(Way):
    """An actor's path, moved to its right."""

    path: Way

    def traveled(self, time: float) -> float:
        return self.path.traveled(time)

    def pose(self, time: float, height: float) -> Pose:
        return self.path.pose(time, height) @ at(0.0, -RIGHT, 0.0)


@dataclass(frozen=True)
class Street:
    """What a street shows, as it was recorded and with an edit; views are those held out."""

    settings: StreetSettings
    street_from_world: Float64[torch.Tensor, "4 4"]
    views: tuple[View, ...]

    @cached_property
    def world(self) -> World:
        """Its things and their ways."""
        return build_world(self.settings)

    @cached_property
    def recorded(self) -> list[Image | None]:
        """Each view of it; None inside of a car."""
        return list(self._traced(self.world, self.views))

    def regions(self, edit: str, number: int) -> list["Region"]:
        """Return where an edit of an actor changes most."""
        actors = list(self.world.actors)
        beside = replace(actors[number], path=Beside(actors[number].path))
        actors[number : number + 1] = {"removed": [], "moved": [beside], "copied": [actors[number], beside]}[edit]
        seen = [place for place, view in enumerate(self.views) if self._may_show(view, number)]
        after = self._traced(replace(self.world, actors=tuple(actors)), [self.views[place] for place in seen])
        regions = []
        for place, image in zip(seen, after, strict=True):
            before = self.recorded[place]
            if before is not None and image is not None:
                changed = np.abs(before - image).max(-1) > VISIBLE
                if changed.sum() >= LEAST:
                    regions.append(Region(self.views[place], before, image, changed))
        return sorted(regions, key=lambda one: -one.changed.sum())[:VIEWS]

    def place(self, number: int, time: float) -> Pose:
        """Return where an actor is at a normalized time, in the street's own world."""
        first, last = self.settings.recorded
        return self.world.actors[number].pose(first + time * (last - first))

    def _traced(self, world: World, views: Sequence[View]) -> Iterator[Image | None]:
        truth = street_truth(self.settings, self.street_from_world, world)
        for view in views:
            yield None if (frame := truth(view)) is None else frame.image.double().numpy() / 255

    def _may_show(self, view: View, number: int) -> bool:
        """Whether the actor is ahead of the camera."""
        place = torch.linalg.solve(self.street_from_world, torch.from_numpy(self.place(number, view.time)[:, 3]))
        return float(view.camera.camera_from_world[2].double() @ place) > 0


@dataclass(frozen=True)
class Region:
    """The pixels of a view that an edit changes."""

    view: View
    before: Image
    after: Image
    changed: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class EditRecord:
    """One edit of one object."""

    street: int
    """Its seed."""
    actor: str
    class_name: str
    edit: str
    tracks: str
    """log or found."""
    names: tuple[str, ...]
    """Of the scene's objects that are the actor."""
    views: int
    pixels: int
    """That the edit changes."""
    psnr: float
    """There, dB: of the edited scene beside the street traced with the edit."""
    psnr_before: float
    """Of both as they were."""
    ghost: float | None
    """Energy of what is left of the object, as a share of its own; None: nothing was taken away."""


@dataclass(frozen=True)
class Mean:
    """Means over the objects that both scenes have."""

    class_name: str
    edit: str
    objects: int
    psnr: dict[str, float]
    """log and found, dB."""
    psnr_before: dict[str, float]
    ghost: dict[str, float]
    """Medians; none where nothing was taken away."""
    lost: float
    """dB by which found boxes are behind, and half of its interval of 95 % (normal, over objects)."""
    lost_within: float | None


def known(stored: StoredScene, street: Street) -> dict[int, tuple[str, ...]]:
    """Return the actors that a scene has as objects, and these: a scene may have an actor in pieces."""
    names: dict[int, list[str]] = {}
    matrix = street.street_from_world.numpy()
    for name, (_, node, instance) in objects_of(stored.scene).items():
        start, end = node.spans[instance].tolist()
        time = min(max((start + end) / 2, 0.0), 1.0)
        place = matrix @ recorded_frames(node, instance)(time)[:, 3]
        places = [street.place(number, time)[:2, 3] for number in range(len(street.world.actors))]
        gaps = [np.linalg.norm(one - place[:2]) for one in places]
        if min(gaps) < NEAR:
            names.setdefault(int(np.argmin(gaps)), []).append(name)
    return {number: tuple(some) for number, some in names.items()}


def edits_of(edit: str, names: Sequence[str]) -> Edits:
    """Return the edit of a scene's objects."""
    if edit == "copied":
        return Edits(added={f"copy_{name}": Added(name, Change(Moved(right=RIGHT))) for name in names})
    return Edits(dict.fromkeys(names, REMOVED if edit == "removed" else Change(Moved(right=RIGHT))))


@torch.no_grad()
def compared(scene: StoredScene, other: StoredScene, regions: Sequence[Region]) -> tuple[float, float, float]:
    """Return PSNR of an edited scene, that of the unedited one in the same pixels, and the ghost."""
    parts: list[list[Float64[np.ndarray, "n 3"]]] = [[], [], []]
    for region in regions:
        new, old = (one.render(region.view).rgb.clamp(0, 1).double().cpu().numpy() for one in (other, scene))
        differences = new - region.after, old - region.before, region.before - region.after
        for part, image in zip(parts, differences, strict=True):
            part.append(image[region.changed])
    error, old_error, thing = map(np.concatenate, parts)
    psnr, before = (float(-10 * np.log10((one**2).mean())) for one in (error, old_error))
    return psnr, before, float((max((error * thing).sum(), 0.0) / (thing**2).sum()) ** 2)


def measured(street: Street, scenes: Mapping[str, StoredScene]) -> Iterator[EditRecord]:
    """Yield each edit of each actor that all scenes know and some view shows."""
    objects = {tracks: known(stored, street) for tracks, stored in scenes.items()}
    for number in sorted(set.intersection(*map(set, objects.values()))):
        actor = street.world.actors[number]
        for edit in EDITS:
            if not (regions := street.regions(edit, number)):
                continue
            pixels = sum(int(region.changed.sum()) for region in regions)
            for tracks, stored in scenes.items():
                names = objects[tracks][number]
                other = replace(stored, scene=edited(stored.scene, edits_of(edit, names)))
                psnr, before, ghost = compared(stored, other, regions)
                yield EditRecord(
                    street.settings.seed, actor.name, actor.model.class_name, edit, tracks, names, len(regions), pixels,
                    psnr, before, ghost if edit == "removed" else None,
                )  # fmt: skip


def means(records: Iterable[EditRecord]) -> Iterator[Mean]:
    """Yield the mean of each class and edit, and that of all classes."""
    every = list(records)
    key = attrgetter("class_name", "edit")
    rows = sorted([*every, *(replace(one, class_name="all") for one in every)], key=key)
    for (class_name, edit), group in groupby(rows, key=key):
        some = list(group)
        by = {tracks: [one for one in some if one.tracks == tracks] for tracks in ("log", "found")}
        lost = np.array([a.psnr - b.psnr for a, b in zip(by["log"], by["found"], strict=True)])
        ghosts = {tracks: [one.ghost for one in own if one.ghost is not None] for tracks, own in by.items()}
        yield Mean(
            class_name,
            edit,
            len(lost),
            {tracks: float(np.mean([one.psnr for one in own])) for tracks, own in by.items()},
            {tracks: float(np.mean([one.psnr_before for one in own])) for tracks, own in by.items()},
            {tracks: float(np.median(own)) for tracks, own in ghosts.items() if own},
            float(lost.mean()),
            1.96 * float(lost.std(ddof=1)) / len(lost) ** 0.5 if len(lost) > 1 else None,
        )


USAGE = """\
python -m benchmarks.edited_objects log=RUN,... found=RUN,...     edits of a street's objects, beside the traced street

  log, found   runs on the same embedded streets, in pairs: with annotated boxes, and with found ones
  streets      folder in which the streets lie or are traced (default: that of the runs)
  out          folder for edited_objects.jsonl (default: outputs/bench)
"""


@dataclass(frozen=True)
class EditsRequest:
    """The script's options."""

    log: tuple[Path, ...]
    found: tuple[Path, ...]
    streets: Path | None = None
    out: Path = Path("outputs/bench")


def street_of(run: Path, streets: Path | None) -> Street:
    """Return the street of a run. Raises ValueError for one of another log."""
    reader = reader_of(open_run_config(run))
    if not isinstance(reader, StreetReader):
        raise ValueError(f"{run} must be of an embedded street, which has a truth with edits: name another run")
    reader = reader if streets is None else replace(reader, root=None, parent=streets)
    return Street(reader.settings, reader.read().dataset_from_world, recorded_views(run).held_out)


def write(request: EditsRequest, file: RecordFile) -> None:
    """Measure each pair of runs, print and write."""
    records = []
    for annotated, found in zip(request.log, request.found, strict=True):
        street = street_of(annotated, request.streets)
        if street_of(found, request.streets).settings != street.settings:
            raise ValueError(f"{annotated} and {found} are of different streets: name them in the same order")
        scenes = {"log": open_scene(annotated, "cpu"), "found": open_scene(found, "cpu")}
        for one in measured(street, scenes):
            records.append(one)
            file.write("edit", one)
            print(one, flush=True)
    for mean in means(records):
        file.write("mean", mean)
        print(mean)


def main(words: list[str]) -> int:
    """Measure as the words say; 2 on wrong usage."""
    command = shlex.join(["python", "-m", "benchmarks.edited_objects", *words])

    def act(request: EditsRequest) -> None:
        torch.set_num_threads(1)
        write(request, record_file(request.out, "edited_objects", command))

    return run_command("edited_objects", USAGE, words, EditsRequest, act)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
