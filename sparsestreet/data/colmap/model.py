"""A sparse model's tables: where they are, and what an entry of each means."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.colmap import binary, text
from sparsestreet.data.colmap.lenses import lens_of
from sparsestreet.data.colmap.rows import CameraRow, ImageRow
from sparsestreet.data.posed_images import PosedImage
from sparsestreet.data.problems import LogError, attempt, fault
from sparsestreet.data.window import listed
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import Lens

_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0")
_LARGEST_IMAGE = 100_000


@dataclass(frozen=True)
class SparseModel:
    """The files of one model."""

    cameras: Path
    images: Path
    points: Path | None
    """None: the model has none."""

    @property
    def files(self) -> list[Path]:
        return [self.cameras, self.images, *([self.points] if self.points else [])]


def find_model(root: Path, folder: str | None) -> SparseModel:
    """The model in a folder below ``root``, in binary where it is in both; None: in a usual one. Raises LogError."""
    places = _PLACES if folder is None else (folder,)
    for place in places:
        for kind in ("bin", "txt"):
            cameras, images, points = (root / place / f"{name}.{kind}" for name in ("cameras", "images", "points3D"))
            if cameras.is_file() and images.is_file():
                return SparseModel(cameras, images, points if points.is_file() else None)
    message = f"no cameras and images, .bin or .txt, in {', '.join(places)}"
    if found := {path.parent for depth in range(4) for path in root.glob("*/" * depth + "images.[bt][ix][nt]")}:
        message += f"; there are models in {listed(sorted(path.relative_to(root).as_posix() for path in found))}"
    raise fault(root, message, "name the folder above sparse/0 and images, or the model's with data.log.model")


def read_images(model: SparseModel, folder: Path) -> list[PosedImage]:
    """The registered images, whose files lie in ``folder``. Raises LogError with every one at fault."""
    lenses = {row.number: _camera(row, model.cameras) for row in _cameras(model.cameras)}
    if not lenses:
        raise fault(model.cameras, "it lists no camera", "run the reconstruction again")
    problems = []
    rows = list(binary.image_rows(model.images) if model.images.suffix == ".bin" else text.image_rows(model.images))
    images = [attempt(problems, lambda row=row: _image(row, lenses, model, folder)) for row in rows]
    if problems:
        raise LogError(problems)
    if not images:
        raise fault(model.images, "it lists no image", "run the reconstruction again")
    return [image for image in images if image is not None]


def read_points(path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Positions, and RGB in [0, 1]. Raises LogError for a broken file."""
    positions, colors = binary.points(path) if path.suffix == ".bin" else text.points(path)
    return torch.from_numpy(positions), torch.from_numpy(colors.astype(np.float32) / 255)


def _cameras(path: Path) -> Iterator[CameraRow]:
    return binary.camera_rows(path) if path.suffix == ".bin" else text.camera_rows(path)


def _camera(row: CameraRow, path: Path) -> tuple[Lens, tuple[int, int]]:
    width, height = row.size
    if not (0 < width <= _LARGEST_IMAGE and 0 < height <= _LARGEST_IMAGE):
        message = f"camera {row.number} has images of {width}x{height} pixels"
        raise fault(path, message, "write the size of its images")
    return lens_of(row.model, row.numbers, path, row.number), row.size


def _image(
    row: ImageRow, lenses: Mapping[int, tuple[Lens, tuple[int, int]]], model: SparseModel, folder: Path
) -> PosedImage:
    written = (folder / row.name).is_file() or "\\" not in row.name
    name = PurePosixPath(row.name if written else row.name.replace("\\", "/"))
    if not row.name or name.is_absolute() or ".." in name.parts:
        message = f"image {row.number} is named {row.name[:60]!r}, which is no file below a folder of images"
        raise fault(model.images, message, "name images relative to that folder")
    if row.camera not in lenses:
        message = f"image {row.name} is of camera {row.camera}, which {model.cameras.name} does not have"
        raise fault(model.images, message, "write both files of one reconstruction")
    pose = np.array(row.pose)
    if not np.isfinite(pose).all() or not 0.99 < np.linalg.norm(pose[:4]) < 1.01:
        message = f"the pose of image {row.name} is no unit quaternion and translation: {pose.round(3).tolist()}"
        raise fault(model.images, message, "run the reconstruction again")
    lens, size = lenses[row.camera]
    camera_from_world = torch.eye(4, dtype=torch.float64)
    camera_from_world[:3, :3] = quat.to_matrix(torch.from_numpy(pose[:4] / np.linalg.norm(pose[:4])))
    camera_from_world[:3, 3] = torch.from_numpy(pose[4:])
    return PosedImage(folder / name, name, lens, size, inverse(camera_from_world))
