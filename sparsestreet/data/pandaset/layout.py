"""Where a sequence lies, and what every car of the data set has."""

from dataclasses import dataclass
from pathlib import Path

import torch

from sparsestreet.data.window import listed
from sparsestreet.geometry import quaternions as quat

FRONT = "front_camera"
"""Its instants are the middles of the sweeps."""
USUAL_CAMERAS = (FRONT, "front_left_camera", "front_right_camera")
CAMERAS = {
    FRONT: 0.0, "front_left_camera": 45.0, "front_right_camera": -45.0, "left_camera": 90.0, "right_camera": -90.0,
    "back_camera": 180.0,
}  # fmt: skip
"""About how many degrees to the left each looks."""
EGO_ROWS = {"back_camera": (260, 1080)}
"""How many of the lowest rows show the recording car, and of how many (NeuRAD crops these)."""
CAMERA_FROM_LIDAR = torch.eye(4, dtype=torch.float64)
"""Front camera (OpenCV's axes) from the spinning lidar (x left, y backward, z up): the static calibration of the
devkit, docs/static_extrinsic_calibration.yaml. The file lidar/poses.json holds another frame, and is not read."""
CAMERA_FROM_LIDAR[:3, :3] = quat.to_matrix(
    torch.tensor(
        [0.016213200031258722, 0.0030578899383849464, 0.7114721800418571, -0.7025205466606356], dtype=torch.float64
    )
)
CAMERA_FROM_LIDAR[:3, 3] = torch.tensor([0.0002585796504896516, -0.03907777167811011, -0.0440125762408362])
OWN_CAR = (1.0, 2.0, 2.0)
"""Meters along the axes of the lidar. Returns nearer in all three are of the recording car (NeuRAD)."""
_MARK = f"camera/{FRONT}/poses.json"
_FOLDERS = (".", "*", "*/*")
"""Of a sequence, below the root."""


@dataclass(frozen=True)
class Layout:
    """The files of one sequence."""

    root: Path

    def camera(self, name: str) -> Path:
        return self.root / "camera" / name

    def image(self, name: str, frame: int) -> Path:
        return self.camera(name) / f"{frame:02d}.jpg"

    @property
    def lidar(self) -> Path:
        return self.root / "lidar"

    def sweep(self, frame: int) -> Path:
        return _packed(self.lidar, frame)

    @property
    def cuboids(self) -> Path:
        return self.root / "annotations" / "cuboids"

    def boxes(self, frame: int) -> Path:
        return _packed(self.cuboids, frame)

    @property
    def cameras(self) -> list[str]:
        return sorted(path.name for path in (self.root / "camera").iterdir() if path.is_dir() and path.name[0] != ".")


def find_sequence(root: Path, scene: str | int | None) -> Layout:
    """The sequence of a name, such as "001" (or 1), at the root or at most two folders below.

    Raises ValueError where there is none, or more than one.
    """
    name = f"{scene:03d}" if isinstance(scene, int) else scene
    length = len(Path(_MARK).parts)
    found = sorted({path.parents[length - 1] for folder in _FOLDERS for path in root.glob(f"{folder}/{_MARK}")})
    if not found:
        raise ValueError(f"no sequence of PandaSet is in {root}: a sequence's folder holds {_MARK}")
    fitting = [one for one in found if name is None or one.resolve().name == name]
    if len(fitting) == 1:
        return Layout(fitting[0])
    names = listed([one.name for one in fitting or found])
    which = f"{len(fitting)} of {len(found)} sequences are" if name else f"there are {len(found)} sequences"
    raise ValueError(f"{which}{f' {name}' if name else ''} in {root}: say data.log.scene=, one of {names}")


def _packed(folder: Path, frame: int) -> Path:
    """The file of an instant: as published, or without compression, as a copy of the data set has it."""
    packed = folder / f"{frame:02d}.pkl.gz"
    plain = folder / f"{frame:02d}.pkl"
    return plain if plain.is_file() and not packed.is_file() else packed
