"""From a sparse model and its images to a recording."""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.colmap.model import find_model, read_images, read_points
from sparsestreet.data.posed_images import PosedReader, PosedTable, there
from sparsestreet.data.reader import FolderSignature

_HELD_OUT = "points of the model were made of all images, of those that are held out too"


@dataclass(frozen=True, kw_only=True)
class ColmapReader(PosedReader):
    """A folder with ``images`` and a sparse model in ``sparse/0``, as COLMAP and 3DGS use it.

    The world is the model's.
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

    def table(self) -> PosedTable:
        model = find_model(self.folder, self.model)
        images, absent = read_images(model, self.folder / Path(self.images)), []
        if self.missing == "skip":
            images, absent = there(images, model.images)
        said = "the model has no points" if model.points is None else _HELD_OUT
        return PosedTable(model.images, images, model.points, [*absent, said], [model.cameras])

    def read_points(self, path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        return read_points(path)
