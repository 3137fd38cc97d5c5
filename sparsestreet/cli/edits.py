"""``edits=FILE``: a trained scene as a file of edits leaves it, and what its user should know of that."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

from sparsestreet.scene.beside import views_of
from sparsestreet.scene.edits import Edits, edited, read_edits
from sparsestreet.scene.edits.edits import off_the_ground
from sparsestreet.scene.edits.file import Open
from sparsestreet.scene.storage import StoredScene, load_scene
from sparsestreet.scene.views import DEFAULT_FRAME_RATE, RecordedViews, seconds_of

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
    for note in [*_notes(edits), *_heights(off_the_ground(stored.scene, edits))]:
        print(note)
    return replace(stored, scene=scene)


def opener(stored: StoredScene) -> Open:
    """Opens other scenes on the device of a scene, each once: Gaussians and the seconds of its log."""

    @cache
    def open_scene(path: Path) -> tuple[StoredScene, float]:
        return load_scene(path, stored.scene.device), log_seconds(views_of(path))

    return open_scene


def log_seconds(views: RecordedViews) -> float:
    """How long a log lasts, at ten frames a second where it has no clock."""
    return seconds_of(views, views.frame_rate or DEFAULT_FRAME_RATE)


def _notes(edits: Edits) -> list[str]:
    gone = [name for name, change in edits.changes.items() if change.hidden or change.path is not None]
    notes = []
    if gone:
        notes.append(
            f"where {', '.join(gone[:3])}{' and others' if gone[3:] else ''} stood, the scene shows what was seen "
            "there at other times; what never was is a guess, and shadows stay"
        )
    if foreign := [name for name, one in edits.added.items() if one.scene is not None]:
        notes.append(f"{', '.join(foreign)}: lit as in the scene it comes from, without a shadow here")
    return notes


def _heights(off: Mapping[str, float]) -> list[str]:
    return [
        f"{name} is {abs(meters):.1f} m {side} the ground: its path needs another z, or none"
        for name, meters in off.items()
        for side in ("above" if meters > 0 else "below",)
        if abs(meters) > _NOT_ON_IT
    ]
