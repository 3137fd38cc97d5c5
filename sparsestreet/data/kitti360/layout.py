"""Where KITTI-360 keeps what, and which part of a sequence is read."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.problems import fault
from sparsestreet.data.window import chosen_cameras, listed

RECTIFIED = ("image_00", "image_01")
FISHEYE = ("image_02", "image_03")


@dataclass(frozen=True)
class SequenceFolders:
    """The folders of a sequence below the data set's root. Frame k has files of the name k."""

    root: Path
    name: str
    """Such as 2013_05_28_drive_0000_sync."""
    cameras: tuple[str, ...]

    @property
    def poses(self) -> Path:
        return self.root / "data_poses" / self.name / "poses.txt"

    @property
    def calibration(self) -> Path:
        return self.root / "calibration"

    @property
    def lidar(self) -> Path:
        return self.root / "data_3d_raw" / self.name / "velodyne_points" / "data"

    @property
    def boxes(self) -> Path | None:
        """Those of the whole sequence (train_full) only where there are no others: sequence 0004."""
        paths = [self.root / "data_3d_bboxes" / part / f"{self.name}.xml" for part in ("train", "train_full")]
        return next((path for path in paths if path.is_file()), None)

    def image(self, camera: str, frame: int) -> Path:
        return images_of(self._images(camera)) / f"{frame:010d}.png"

    def stamps(self, camera: str) -> Path:
        return self._images(camera) / "timestamps.txt"

    def sweep(self, frame: int) -> Path:
        return self.lidar / f"{frame:010d}.bin"

    def semantics(self, camera: str) -> Path:
        return self.root / "data_2d_semantics" / "train" / self.name / camera / "semantic"

    def _images(self, camera: str) -> Path:
        return self.root / "data_2d_raw" / self.name / camera


def find_sequence(root: Path, sequence: int | str | None, cameras: Sequence[str] | None) -> SequenceFolders:
    """None: the only one. Raises LogError where the sequence is not there, ValueError for a name or cameras that cannot
    be."""
    name = _name(root, sequence)
    images = root / "data_2d_raw" / name
    on_disk = [camera for camera in (*RECTIFIED, *FISHEYE) if images_of(images / camera).is_dir()]
    usual = [camera for camera in RECTIFIED if camera in on_disk]
    if not on_disk or not (usual or cameras):
        message = "it holds neither image_00/data_rect nor image_01/data_rect"
        raise fault(images, message, "unpack the perspective images")
    return SequenceFolders(root, name, chosen_cameras(on_disk, usual if cameras is None else cameras, root))


def _name(root: Path, sequence: int | str | None) -> str:
    """Of the folders of a sequence, or of the only one."""
    found = sorted(path.name[-9:-5] for path in root.glob("data_2d_raw/2013_05_28_drive_????_sync"))
    there = f"there are sequences {listed(found)}" if found else "root must be the folder of data_2d_raw"
    if sequence is None:
        if not found:
            raise fault(root / "data_2d_raw", f"there is no sequence; {there}", "set data.root")
        if len(found) > 1:
            raise ValueError(f"{there} in {root}: name one (data.log.sequence)")
        (sequence,) = found
    number = str(sequence).removeprefix("2013_05_28_drive_").removesuffix("_sync")
    if not (number.isascii() and number.isdigit() and len(number) <= 4):
        message = f"a sequence of KITTI-360 is a number from 0 to 18, got {sequence!r}; {there}: set data.log.sequence"
        raise ValueError(message)
    name = f"2013_05_28_drive_{int(number):04d}_sync"
    if not (root / "data_2d_raw" / name).is_dir():
        message = f"the sequence is not there; {there}"
        raise fault(root / "data_2d_raw" / name, message, "set data.root and data.log.sequence")
    return name


def images_of(camera: Path) -> Path:
    """The folder of a camera's images: rectified ones, or as the fisheye recorded them."""
    return camera / ("data_rgb" if camera.name in FISHEYE else "data_rect")
