"""``RUN/rig.json``: what a simulator needs to know of the recording car; training writes it once."""

from dataclasses import dataclass, field

from sparsestreet.records.file import JsonFile
from sparsestreet.records.strict_json import EXACT, version

RIG_FORMAT = 1
"""Version of ``rig.json``; raised when a key changes its meaning."""

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class RigRecord:
    """The content of ``rig.json``; runs of earlier versions have none."""

    format: int = version(RIG_FORMAT, "train the run again, or delete the file")
    camera_names: tuple[str, ...]
    """As the data set calls them, by camera index; empty: they have none but their indices."""
    dataset_from_world: Matrix = field(metadata=EXACT)
    """4x4: adds back what re-centering took away from the data set's own world."""
    world_from_vehicle: tuple[Matrix, ...] | None = field(metadata=EXACT)
    """4x4 of each frame, x ahead, y left, z up, in the re-centered world; None: the log says nothing of the car."""

    def __post_init__(self) -> None:
        for matrix in (self.dataset_from_world, *(self.world_from_vehicle or ())):
            if len(matrix) != 4 or any(len(row) != 4 for row in matrix):
                raise ValueError(f"a pose is 4 x 4 numbers, got {matrix}")


RIG = JsonFile("rig.json", RigRecord)
