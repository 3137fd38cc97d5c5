"""From a sparse model and its images to a recording."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sparsestreet.data.colmap.model import SparseModel, find_model, read_images, read_points
from sparsestreet.data.posed_images import PosedImages, check_images, recording_of, sort_images, there
from sparsestreet.data.problems import LogError, Missing, Problem, attempt, check_missing
from sparsestreet.data.reader import FolderSignature, LogFiles
from sparsestreet.data.recording import RecordedReader, Recording

_HELD_OUT = "points of the model were made of all images, of those that are held out too"


@dataclass(frozen=True, kw_only=True)
class ColmapReader(RecordedReader):
    """A folder with ``images`` and a sparse model in ``sparse/0``, as COLMAP and 3DGS use it.

    The world is the model's. There are no returns and no boxes.
    """

    marks = FolderSignature(
        tuple(
            f"{place}cameras.{kind}"
            for place in ("", "sparse/0/", "sparse/", "colmap/sparse/0/")
            for kind in ("bin", "txt")
        )
    )

    model: str | None = None
    """The model's folder below the root; None: the root, sparse/0, sparse or colmap/sparse/0."""
    images: str = "images"
    """The folder of the images below the root."""
    scale: float = 1.0
    """Meters to a unit of the model."""
    pinhole_fov: float | None = None
    """Degrees that the pinhole of a fisheye sees from left to right; None: its resolution is that of the center."""
    missing: Missing = "error"
    """skip: images that are listed and have no file are left out with a note, before frames are counted."""

    def __post_init__(self) -> None:
        check_missing(self.missing)

    def recording(self) -> Recording:
        model, images, absent = self._read()
        if problems := check_images(images, model.images, masks=self.masks, decode=False):
            raise LogError(problems)
        return recording_of(
            self,
            images,
            scale=self.scale,
            pinhole_fov=self.pinhole_fov,
            sparse_points=None if model.points is None else partial(read_points, model.points),
            points_file=model.points,
            notes=[*absent, "the model has no points" if model.points is None else _HELD_OUT],
        )

    def check_contents(self) -> list[Problem]:
        model, images, _ = self._read()
        problems = check_images(images, model.images, masks=self.masks, decode=True)
        if model.points is not None:
            attempt(problems, partial(read_points, model.points))
        return problems

    def files(self) -> LogFiles:
        model, images, _ = self._read()
        return LogFiles([model.cameras, model.images], [*(image.path for image in images.images), *model.files[2:]])

    def _read(self) -> tuple[SparseModel, PosedImages, list[str]]:
        model = find_model(self.folder, self.model)
        found = read_images(model, self.folder / Path(self.images))
        found, absent = there(found, model.images) if self.missing == "skip" else (found, [])
        images = sort_images(
            found, model.images, cameras=self.cameras, first_frame=self.first_frame, last_frame=self.last_frame
        )
        return model, images, absent
