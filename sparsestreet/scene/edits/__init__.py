"""Edits of a trained scene: objects hidden, moved, held, copied, inserted from another scene."""

from sparsestreet.scene.edits.edits import REMOVED, Added, Edits, edited, objects_of
from sparsestreet.scene.edits.file import edits_of, read_edits
from sparsestreet.scene.edits.nodes import Change
from sparsestreet.scene.edits.paths import AsRecorded, Driven, Given, Held, Moved, Path, placed

__all__ = [
    "REMOVED", "Added", "AsRecorded", "Change", "Driven", "Edits", "Given", "Held", "Moved", "Path", "edited",
    "edits_of", "objects_of", "placed", "read_edits",
]  # fmt: skip
