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
    """4x4, x ahead, y left, z up, in the re-centered world; None: the log says nothing of the car."""
    vehicle_stamps: tuple[int, ...] | None
    """Nanoseconds on the log's clock, one a pose; None: the poses are those of the frames."""

    def __post_init__(self) -> None:
        for matrix in (self.dataset_from_world, *(self.world_from_vehicle or ())):
            if len(matrix) != 4 or any(len(row) != 4 for row in matrix):
                raise ValueError(f"a pose is 4 x 4 numbers, got {matrix}")
        poses, stamps = self.world_from_vehicle, self.vehicle_stamps
        if stamps is not None and len(stamps) != len(poses or ()):
            raise ValueError(f"each pose has a stamp, got {len(poses or ())} poses and {len(stamps)} stamps")
        if poses is not None and not poses:
            raise ValueError("a vehicle has a pose, got none")


RIG = JsonFile("rig.json", RigRecord)
