"""From a sparse model and its images to a recording: where its tables are, and what an entry of each means."""

import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.posed_images import PosedImage, PosedReader, PosedTable, there
from sparsestreet.data.problems import LogError, attempt, fault
from sparsestreet.data.reader import FolderSignature, listed
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, Lens, Rational


@dataclass(frozen=True)
class CameraModel:
    """One of COLMAP's models."""

    name: str
    lens: type[Lens] | None
    """None: not read."""
    numbers: tuple[str, ...]
    """In the order of the files; f stands for fx and fy."""


_ONE, _TWO = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
_FISHEYE = ("k1", "k2", "k3", "k4")
_BROWN = ("k1", "k2", "p1", "p2")
MODELS = (
    CameraModel("SIMPLE_PINHOLE", BrownConrady, _ONE),
    CameraModel("PINHOLE", BrownConrady, _TWO),
    CameraModel("SIMPLE_RADIAL", BrownConrady, (*_ONE, "k1")),
    CameraModel("RADIAL", BrownConrady, (*_ONE, "k1", "k2")),
    CameraModel("OPENCV", BrownConrady, (*_TWO, *_BROWN)),
    CameraModel("OPENCV_FISHEYE", Fisheye, (*_TWO, *_FISHEYE)),
    CameraModel("FULL_OPENCV", Rational, (*_TWO, *_BROWN, "k3", "k4", "k5", "k6")),
    CameraModel("FOV", None, (*_TWO, "omega")),
    CameraModel("SIMPLE_RADIAL_FISHEYE", Fisheye, (*_ONE, "k1")),
    CameraModel("RADIAL_FISHEYE", Fisheye, (*_ONE, "k1", "k2")),
    CameraModel("THIN_PRISM_FISHEYE", None, (*_TWO, *_BROWN, "k3", "k4", "sx1", "sy1")),
)
"""By their numbers in binary files."""


def lens_of(model: CameraModel, values: Sequence[float], path: Path, camera: int) -> Lens:
    """Raise LogError for a model that is not read, and numbers that are no lens."""
    if model.lens is None:
        message = f"camera {camera} is a {model.name}, a lens that is not read"
        raise fault(path, message, "run COLMAP's image_undistorter, and read its images and model")
    numbers = dict(zip(model.numbers, map(float, values), strict=True))
    if "f" in numbers:
        focal = numbers.pop("f")
        numbers |= {"fx": focal, "fy": focal}
    try:
        return model.lens(**numbers)
    except ValueError as error:
        raise fault(
            path, f"camera {camera}: {error}", "run the reconstruction again, or leave the camera out"
        ) from error


@dataclass(frozen=True)
class CameraRow:
    """An entry of ``cameras``."""

    number: int
    model: CameraModel
    size: tuple[int, int]
    """(width, height), pixels."""
    numbers: tuple[float, ...]
    """As many as the model has."""


@dataclass(frozen=True)
class ImageRow:
    """An entry of ``images``."""

    number: int
    name: str
    camera: int
    pose: tuple[float, ...]
    """camera_from_world: a quaternion wxyz and a translation."""


_REMEDY = "copy or export the model again"
_MAX_NAME_BYTES = 4096
_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_COUNT = struct.Struct("<Q")
_OBSERVATION, _TRACK_ELEMENT = 24, 8
"""Bytes of an image's observation (x, y, point) and of a point's (image, place)."""


@dataclass
class _OpenFile:
    """A file and how much of it is left."""

    file: BinaryIO
    path: Path
    left: int

    def take(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack(self.bytes(layout.size, what))

    def bytes(self, count: int, what: str) -> bytes:
        self._claim(count, what)
        return self.file.read(count)

    def skip(self, count: int, what: str) -> None:
        self._claim(count, what)
        self.file.seek(count, os.SEEK_CUR)

    def name(self, what: str) -> str:
        """Up to a zero."""
        letters = bytearray()
        while (letter := self.bytes(1, what)) != b"\0":
            letters += letter
            if len(letters) > _MAX_NAME_BYTES:
                raise fault(self.path, f"{what} has a name of more than {_MAX_NAME_BYTES} bytes", _REMEDY)
        try:
            return letters.decode()
        except UnicodeDecodeError as error:
            raise fault(self.path, f"{what} has a name that is no text", _REMEDY) from error

    def count(self, least: int, what: str) -> int:
        """Of entries that take at least so many bytes each."""
        (count,) = self.take(_COUNT, what)
        if count * least > self.left:
            message = f"it announces {count:,} {what}, but {self.left:,} bytes follow"
            raise fault(self.path, message, _REMEDY)
        return count

    def end(self) -> None:
        if self.left:
            raise fault(self.path, f"{self.left:,} bytes follow its last entry", _REMEDY)

    def _claim(self, count: int, what: str) -> None:
        if count > self.left:
            raise fault(self.path, f"the file ends within {what}", _REMEDY)
        self.left -= count


def binary_camera_rows(path: Path) -> Iterator[CameraRow]:
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        for _ in range(table.count(_CAMERA.size, "cameras")):
            number, model, width, height = table.take(_CAMERA, "a camera")
            if not 0 <= model < len(MODELS):
                message = f"camera {number} has model {model}, of which nothing is known"
                raise fault(path, message, "run COLMAP's image_undistorter, and read its images and model")
            layout = struct.Struct(f"<{len(MODELS[model].numbers)}d")
            yield CameraRow(number, MODELS[model], (width, height), table.take(layout, f"camera {number}"))
        table.end()


def binary_image_rows(path: Path) -> Iterator[ImageRow]:
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        for _ in range(table.count(_IMAGE.size + 1 + _COUNT.size, "images")):
            number, *pose, camera = table.take(_IMAGE, "an image")
            what = f"image {number}"
            name = table.name(what)
            table.skip(_OBSERVATION * table.count(_OBSERVATION, f"observations of {what}"), what)
            yield ImageRow(number, name, camera, tuple(pose))
        table.end()


def binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions n x 3 in float64 and RGB n x 3 in uint8."""
    check_regular(path)
    with path.open("rb") as file:
        table = _OpenFile(file, path, path.stat().st_size)
        count = table.count(_POINT.size, "points")
        positions, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
        for row in range(count):
            _, *values, _, length = table.take(_POINT, f"point {row}")
            positions[row], colors[row] = values[:3], values[3:]
            table.skip(_TRACK_ELEMENT * length, f"point {row}")
        table.end()
    return positions, colors


_MAX_SHOWN = 60
"""Words."""
_MAX_LINE = 32_000_000
"""Bytes: an image's line holds all of its observations."""
_MODELS = {model.name: model for model in MODELS}


def text_camera_rows(path: Path) -> Iterator[CameraRow]:
    for number, line in _entries(path):
        words = line.split()
        model = _MODELS.get(words[1]) if len(words) > 1 else None
        if model is None:
            name = words[1][:40] if len(words) > 1 else ""
            raise _broken(path, number, f"its model is {name!r}, of which nothing is known")
        if len(words) != 4 + len(model.numbers):
            raise _broken(path, number, f"a {model.name} has {len(model.numbers)} numbers, not {len(words) - 4}")
        try:
            size = int(words[2]), int(words[3])
            yield CameraRow(int(words[0]), model, size, tuple(map(float, words[4:])))
        except ValueError as error:
            raise _broken(path, number, f"it is no camera ({error})") from error


def text_image_rows(path: Path) -> Iterator[ImageRow]:
    """Two lines an image; the second, of observations, may be empty and is passed over. Files that are written by hand
    leave these lines out, so what cannot be one is the next image."""
    number, waiting, observed = 0, False, False
    for number, line in _lines(path):
        if line.startswith("#"):
            continue
        if waiting and (not line.strip() or _observes(line)):
            waiting, observed = False, True
            continue
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            if len(words) != 10:
                raise ValueError("10 words are wanted")
            pose = tuple(map(float, words[1:8]))
            yield ImageRow(int(words[0]), words[9].strip(), int(words[8]), pose)
        except ValueError as error:
            raise _broken(path, number, f"it is no image ({error})") from error
        waiting = True
    if waiting and observed:
        raise _broken(path, number, "no line of observations follows it, which may be empty")


def _observes(line: str) -> bool:
    """Whether these are triples of numbers; of a long line the last word tells, because no name is as long."""
    words = line.split(maxsplit=_MAX_SHOWN)
    if len(words) > _MAX_SHOWN:
        words = [line.rsplit(maxsplit=1)[-1]] * 3
    try:
        return len(words) % 3 == 0 and all(float(word) < math.inf for word in words)
    except ValueError:
        return False


def text_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions n x 3 in float64 and RGB n x 3 in uint8."""
    positions: list[tuple[float, ...]] = []
    colors: list[tuple[int, ...]] = []
    for number, line in _entries(path):
        words = line.split(maxsplit=7)
        try:
            position, color = tuple(map(float, words[1:4])), tuple(map(int, words[4:7]))
        except ValueError as error:
            raise _broken(path, number, f"it is no point ({error})") from error
        if len(color) != 3 or not all(0 <= value <= 255 for value in color):
            raise _broken(path, number, "it is no point of three lengths and three colors from 0 to 255")
        positions.append(position)
        colors.append(color)
    return np.array(positions, np.float64).reshape(-1, 3), np.array(colors, np.uint8).reshape(-1, 3)


def _entries(path: Path) -> Iterator[tuple[int, str]]:
    return ((number, line) for number, line in _lines(path) if line.strip() and not line.startswith("#"))


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and their numbers, counted from 1."""
    try:
        check_regular(path)
        with path.open(encoding="utf-8") as file:
            number = 0
            while line := file.readline(_MAX_LINE):
                number += 1
                if len(line) == _MAX_LINE:
                    raise _broken(path, number, f"it has more than {_MAX_LINE:,} letters")
                yield number, line
    except UnicodeDecodeError as error:
        raise fault(path, f"the file is no text ({error})", _REMEDY) from error


def _broken(path: Path, line: int, message: str) -> LogError:
    return fault(path, f"line {line}: {message}", _REMEDY)


_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0")
_MAX_IMAGE = 100_000


@dataclass(frozen=True)
class SparseModel:
    """The files of one model."""

    cameras: Path
    images: Path
    points: Path | None
    """None: the model has none."""


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
    rows = list(binary_image_rows(model.images) if model.images.suffix == ".bin" else text_image_rows(model.images))
    images = [attempt(problems, lambda row=row: _image(row, lenses, model, folder)) for row in rows]
    if problems:
        raise LogError(problems)
    if not images:
        raise fault(model.images, "it lists no image", "run the reconstruction again")
    return [image for image in images if image is not None]


def _cameras(path: Path) -> Iterator[CameraRow]:
    return binary_camera_rows(path) if path.suffix == ".bin" else text_camera_rows(path)


def _camera(row: CameraRow, path: Path) -> tuple[Lens, tuple[int, int]]:
    width, height = row.size
    if not (0 < width <= _MAX_IMAGE and 0 < height <= _MAX_IMAGE):
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
        """Positions, and RGB in [0, 1]. Raises LogError for a broken file."""
        positions, colors = binary_points(path) if path.suffix == ".bin" else text_points(path)
        return torch.from_numpy(positions), torch.from_numpy(colors.astype(np.float32) / 255)
