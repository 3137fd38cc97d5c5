"""What the commands that open a trained scene have in common: its file, its views, its edits."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch

from sparsestreet.cli.config.targets import open_run_config
from sparsestreet.cli.config.validate import device_of
from sparsestreet.naming import one_line
from sparsestreet.scene.edits import Edits, edited, read_edits
from sparsestreet.scene.edits.edits import off_the_ground
from sparsestreet.scene.edits.file import Open
from sparsestreet.scene.edits.nodes import ALWAYS
from sparsestreet.scene.edits.paths import Driven, Held, Moved
from sparsestreet.scene.storage import StoredScene, load_scene, views_of
from sparsestreet.scene.views import DEFAULT_FRAME_RATE, RecordedViews, read_views, seconds_of


def open_scene(path: Path, device: str | None = None, parts: Sequence[str] = ()) -> StoredScene:
    """The scene file, or that of a run's folder, on a device; None: a GPU if there is one.

    A scene file names classes, but imports nothing from outside this package: of a run's folder those are imported
    that lie in ``parts``, modules that the user's command trusts.

    Raises FileNotFoundError where there is none, ValueError for a device that is not there or a file that is no scene.
    """
    if (path / ".hydra").is_dir():
        open_run_config(path, parts)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    return load_scene(path, device_of(device, f"device={device}", "say device=cpu, or check the driver"))


def folder_of(scene: Path) -> Path:
    """The folder of a run that was given as it is, or by its scene file."""
    return scene if scene.is_dir() else scene.parent


def recorded_views(scene: Path, file: Path | None = None) -> RecordedViews:
    """The views of a file, or those of the scene. Raises FileNotFoundError or ValueError for none or damaged ones."""
    return views_of(scene) if file is None else read_views(file)


_SAME = 1e-6
"""Of normalized time."""
_NOT_ON_IT = 1.0
"""Meters between an object and the ground of which the user is told."""


def with_edits(stored: StoredScene, views: RecordedViews, file: Path | None) -> StoredScene:
    """The scene with the edits of a file, whose seconds are those of the log; None: as it is. Prints what to know.

    Raises FileNotFoundError or ValueError for what is wrong with the file or a scene that it names.
    """
    if file is None:
        return stored

    edits = read_edits(file, log_seconds(views), opener(stored))
    scene = edited(stored.scene, edits)
    for note in [*_notes(edits), *_late(edits, log_seconds(views)), *_heights(off_the_ground(stored.scene, edits))]:
        print(note)
    return replace(stored, scene=scene)


def opener(stored: StoredScene) -> Open:
    """Open other scenes on the device of a scene, each once: Gaussians and the seconds of its log."""

    @cache
    def open_scene(path: Path) -> tuple[StoredScene, float]:
        return load_scene(path, stored.scene.device), log_seconds(views_of(path))

    return open_scene


def log_seconds(views: RecordedViews) -> float:
    """How long a log lasts, at ten frames a second where it has no clock."""
    return seconds_of(views, views.frame_rate or DEFAULT_FRAME_RATE)


def _late(edits: Edits, seconds: float) -> Iterator[str]:
    """Yield a line for each time of the edits that the log, of so many seconds, does not reach."""
    changes = {**edits.changes, **{name: one.change for name, one in edits.added.items()}}
    for name, change in changes.items():
        path = change.path
        spans = [("hide", span) for span in change.hidden if span != ALWAYS]
        if isinstance(path, Moved) and path.during is not None:
            spans.append(("during", path.during))
        if isinstance(path, Held):
            spans.append(("hold", (path.at, path.at)))
        if isinstance(path, Driven):
            spans.append(("path", (min(path.times), max(path.times))))
        for what, (start, end) in spans:
            if start < -_SAME or end > 1 + _SAME:
                times = f"{seconds * start:g} s" if start == end else f"{seconds * start:g} to {seconds * end:g} s"
                ends = f"ends at {seconds:.4g} s" if end > 1 + _SAME else "begins at 0 s"
                unseen = start > 1 + _SAME or end < -_SAME
                meant = "nothing of that is seen" if unseen and what != "hold" else "it is as it is there"
                yield f"{name}: {what} {times}: the log {ends}, {meant}"


def _notes(edits: Edits) -> list[str]:
    gone = [
        one_line(name)
        for name, change in edits.changes.items()
        if change.path is not None or any(start <= 1 and end >= 0 for start, end in change.hidden)
    ]
    notes = []
    if gone:
        notes.append(
            f"where {', '.join(gone[:3])}{' and others' if gone[3:] else ''} stood, the scene shows what was seen "
            "there at other times; what never was is a guess, and shadows stay"
        )
    if foreign := [name for name, one in edits.added.items() if one.scene is not None]:
        notes.append(f"{', '.join(map(one_line, foreign))}: lit as in the scene it comes from, without a shadow here")
    return notes


def _heights(off: Mapping[str, float]) -> list[str]:
    return [
        f"{one_line(name)} is {abs(meters):.1f} m {side} the ground: its path needs another z, or none"
        for name, meters in off.items()
        for side in ("above" if meters > 0 else "below",)
        if abs(meters) > _NOT_ON_IT
    ]
