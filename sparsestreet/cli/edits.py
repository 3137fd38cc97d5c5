"""``edits=FILE``: a trained scene as a file of edits leaves it, and what its user should know of that."""

from dataclasses import replace
from functools import cache
from pathlib import Path

from sparsestreet.naming import one_line
from sparsestreet.scene.beside import views_of
from sparsestreet.scene.edits import Edits, edited, read_edits
from sparsestreet.scene.edits.file import Open
from sparsestreet.scene.storage import StoredScene, load_scene
from sparsestreet.scene.views import DEFAULT_FRAME_RATE, RecordedViews, seconds_of


def with_edits(stored: StoredScene, views: RecordedViews, file: Path | None) -> StoredScene:
    """The scene with the edits of a file, whose seconds are those of the log; None: as it is. Prints what to know.

    Raises FileNotFoundError or ValueError for what is wrong with the file or a scene that it names.
    """
    if file is None:
        return stored

    edits = read_edits(file, log_seconds(views), opener(stored))
    scene = edited(stored.scene, edits)
    for note in _notes(edits):
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
    gone = [one_line(name) for name, change in edits.changes.items() if change.hidden or change.path is not None]
    notes = []
    if gone:
        notes.append(
            f"where {', '.join(gone[:3])}{' and others' if gone[3:] else ''} stood, the scene shows what was seen "
            "there at other times; what never was is a guess, and shadows stay"
        )
    if foreign := [name for name, one in edits.added.items() if one.scene is not None]:
        notes.append(f"{', '.join(map(one_line, foreign))}: lit as in the scene it comes from, without a shadow here")
    return notes
