"""From a folder with ``transforms.json`` to a recording."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sparsestreet.data.fingerprint import LogFiles
from sparsestreet.data.marks import Marks
from sparsestreet.data.nerfstudio.transforms import Transforms, read_transforms
from sparsestreet.data.ply import read_ply
from sparsestreet.data.posed_images import PosedImages, check_images, recording_of, sort_images
from sparsestreet.data.problems import LogError, Missing, Problem, attempt, check_missing, missing_notes
from sparsestreet.data.recording import RecordedReader, Recording


@dataclass(frozen=True, kw_only=True)
class NerfstudioReader(RecordedReader):
    """A folder with ``transforms.json``, as nerfstudio and instant-ngp write it.

    The world is that of the file's poses and points. There are no returns and no boxes.
    """

    marks = Marks(("transforms.json",))

    scale: float = 1.0
    """Meters to a unit of the file."""
    pinhole_fov: float | None = None
    """Degrees that the pinhole of a fisheye sees from left to right; None: its resolution is that of the center."""
    missing: Missing = "error"
    """skip: images that are listed and have no file are left out with a note, before frames are counted."""

    def __post_init__(self) -> None:
        check_missing(self.missing)

    def recording(self) -> Recording:
        transforms, images = self._read()
        problems = self._missing_points(transforms) + check_images(images, self._table, masks=self.masks, decode=False)
        if problems:
            raise LogError(problems)
        return recording_of(
            self,
            images,
            scale=self.scale,
            pinhole_fov=self.pinhole_fov,
            sparse_points=None if transforms.points is None else partial(read_ply, transforms.points),
            points_file=transforms.points,
            notes=_notes(transforms),
        )

    def check_contents(self) -> list[Problem]:
        transforms, images = self._read()
        problems = check_images(images, self._table, masks=self.masks, decode=True) + self._missing_points(transforms)
        if transforms.points is not None and transforms.points.is_file():
            attempt(problems, partial(read_ply, transforms.points))
        return problems

    def files(self) -> LogFiles:
        transforms, images = self._read()
        pixels = [path for image in images.images for path in (image.path, image.valid) if path]
        return LogFiles([self._table], [*dict.fromkeys(pixels), *([transforms.points] if transforms.points else [])])

    @property
    def _table(self) -> Path:
        return self.folder / "transforms.json"

    def _read(self) -> tuple[Transforms, PosedImages]:
        transforms = read_transforms(self._table, skip=self.missing == "skip")
        images = sort_images(
            transforms.images,
            self._table,
            cameras=self.cameras,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
        )
        return transforms, images

    def _missing_points(self, transforms: Transforms) -> list[Problem]:
        if transforms.points is None or transforms.points.is_file():
            return []
        message = "the file is missing, which transforms.json names as ply_file_path"
        return [Problem(transforms.points, message, "write it, or remove ply_file_path")]


def _notes(transforms: Transforms) -> list[str]:
    notes = missing_notes(transforms.absent, transforms.absent + len(transforms.images))
    if transforms.unread:
        notes.append(f"nothing reads {', '.join(transforms.unread)} of transforms.json")
    if transforms.has_times:
        notes.append("times of the frames order them, but their unit is not known: they are no clock")
    if transforms.has_depth:
        notes.append("depth images of the frames are not read")
    return notes
