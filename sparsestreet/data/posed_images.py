"""Images with poses and lenses and nothing else, as structure from motion leaves them: cameras and instants from names.

Images of one folder with the same lens are a camera. Images of equal names in different folders are an instant, which
is how COLMAP wants rigs to be written; images of one folder alone are an instant each. The order is that of the names,
with numbers in them counted, or of times where the data set gives them.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.data.images import check_camera_images, check_image_sizes, read_mask
from sparsestreet.data.poses import check_extent, check_rigid
from sparsestreet.data.problems import (
    LogError,
    Missing,
    Problem,
    attempt,
    check_missing,
    fault,
    missing_files,
    missing_notes,
)
from sparsestreet.data.reader import LogFiles, chosen_cameras, frame_window
from sparsestreet.data.recorded_images import Pixels, RecordedImage
from sparsestreet.data.recording import RecordedReader, Recording
from sparsestreet.data.rig import check_lens_camera, lens_camera
from sparsestreet.geometry.lenses import Lens


@dataclass(frozen=True)
class PosedImage:
    """One image, its pose and the lens that recorded it."""

    path: Path
    name: PurePosixPath
    """As the data set names it: folders tell cameras, stems instants."""
    lens: Lens
    size: tuple[int, int]
    """(width, height) that the lens is calibrated for."""
    world_from_camera: Float64[Tensor, "4 4"]
    """OpenCV's axes, the data set's own world and unit."""
    valid: Path | None = None
    """A mask that is black where the image is not to be used."""
    time: float | int | None = None
    """When it was taken, in whatever unit."""


@dataclass(frozen=True)
class PosedImages:
    """The images of a data set that are read, sorted into cameras and instants."""

    cameras: Mapping[str, tuple[Lens, tuple[int, int]]]
    """Name -> lens and size, those that are read."""
    instants: Sequence[Mapping[str, PosedImage]]
    """Camera -> image, for each instant of the window."""

    @property
    def images(self) -> list[PosedImage]:
        return [image for instant in self.instants for image in instant.values()]


def sort_images(
    images: Sequence[PosedImage],
    table: Path,
    *,
    cameras: Sequence[str] | None,
    first_frame: int,
    last_frame: int,
) -> PosedImages:
    """Cameras and instants of some images. ``table`` is the file that lists them.

    Raises LogError for an instant with two images of a camera, ValueError for cameras or frames that are not there.
    """
    names = _camera_names(images)
    found = sorted(set(names.values()), key=natural)
    chosen = chosen_cameras(found, cameras, table.parent)
    by_instant: dict[object, dict[str, PosedImage]] = {}
    for image in images:
        name = names[_kind(image)]
        if name not in chosen:
            continue
        instant = by_instant.setdefault(_instant(image), {})
        if name in instant:
            message = f"{instant[name].name} and {image.name} are of one camera and one instant"
            raise fault(table, message, "name images of a camera differently, or give them different times")
        instant[name] = image
    ordered = [by_instant[key] for key in sorted(by_instant, key=natural)]
    window = frame_window(len(ordered), first_frame, last_frame, table.parent)
    kinds = {name: (lens, size) for (_, lens, size), name in names.items()}
    return PosedImages({name: kinds[name] for name in chosen}, [ordered[place] for place in window])


def there(images: Sequence[PosedImage], table: Path) -> tuple[list[PosedImage], list[str]]:
    """Return the images whose files are there, and what is said of the others, which ``table`` lists too. Raises
    LogError where all are missing."""
    found = [image for image in images if image.path.is_file()]
    if not found:
        message = f"none of the {len(images)} images that it lists is there, the first is {images[0].path}"
        raise fault(table, message, "write the images, or name the folder that holds them")
    return found, missing_notes(len(images) - len(found), len(images))


@dataclass(frozen=True)
class PosedTable:
    """What a data set says of its images."""

    path: Path
    """The file that lists them."""
    images: Sequence[PosedImage]
    points: Path | None
    """The file of its sparse points."""
    notes: Sequence[str]
    others: Sequence[Path] = ()
    """More files of numbers."""


@dataclass(frozen=True, kw_only=True)
class PosedReader(RecordedReader):
    """A data set of posed images, in a unit of its own. There are no returns and no boxes."""

    scale: float = 1.0
    """Meters to a unit of the data set."""
    pinhole_fov: float | None = None
    """Degrees that the pinhole of a fisheye sees from left to right; None: its resolution is that of the center."""
    missing: Missing = "error"
    """skip: images that are listed and have no file are left out with a note, before frames are counted."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_missing(self.missing)

    @abstractmethod
    def table(self) -> PosedTable:
        """All images of the data set. Raises LogError with every one at fault."""

    @abstractmethod
    def read_points(self, path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Positions in the unit of the data set, and RGB in [0, 1]."""

    def recording(self) -> Recording:
        if not 0 < self.scale < math.inf:
            raise ValueError(
                f"scale must be positive meters to a unit, got {self.scale:g}: 1 leaves lengths as they are"
            )
        table, images = self._sorted()
        if problems := _missing_points(table) + self._problems(images, table.path):
            raise LogError(problems)
        rig = [
            lens_camera(
                name,
                index,
                lens=lens,
                recorded_size=size,
                width=self.width,
                pinhole_fov=self.pinhole_fov,
                undistort=self.undistort,
            )
            for index, (name, (lens, size)) in enumerate(images.cameras.items())
        ]
        shots = [
            RecordedImage(frame, camera.index, _scaled(image.world_from_camera, self.scale), image, image.path.stem)
            for frame, instant in enumerate(images.instants)
            for camera in rig
            if (image := instant.get(camera.name)) is not None
        ]
        pixels = Pixels(rig, [size for _, size in images.cameras.values()], self.given)
        has_own = any(image.valid for image in images.images)
        return Recording(
            name=self.folder.resolve().name,
            rig=rig,
            shots=shots,
            read_image=pixels.image,
            read_masks=partial(_masks, pixels),
            mask_kinds=self.given.beside(["ego"] if has_own else ()),
            sparse_points=None if table.points is None else partial(self._scaled_points, table.points),
            points_file=table.points,
            notes=(_note_of_scale(shots, self.scale), *table.notes),
        )

    def files(self) -> LogFiles:
        table, images = self._sorted()
        pixels = [path for image in images.images for path in (image.path, image.valid) if path]
        return LogFiles(
            [table.path, *table.others], [*dict.fromkeys(pixels), *([table.points] if table.points else [])]
        )

    def _sorted(self) -> tuple[PosedTable, PosedImages]:
        table = self.table()
        images = sort_images(
            table.images,
            table.path,
            cameras=self.cameras,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
        )
        return table, images

    def _problems(self, images: PosedImages, table: Path) -> list[Problem]:
        """What is wrong with lenses, poses and files of images and masks; no pixel is decoded."""
        problems = missing_files(path for image in images.images for path in (image.path, image.valid) if path)
        placed = []
        for name, (lens, size) in images.cameras.items():
            own = [instant[name] for instant in images.instants if name in instant]
            attempt(problems, partial(check_lens_camera, table, lens, size))
            valid = [image.valid for image in own if image.valid]
            problems += check_camera_images(name, [image.path for image in own], valid, decode=False)
            problems += check_image_sizes(name, size, [image.path for image in own])
            for image in own:
                attempt(problems, partial(check_rigid, image.world_from_camera, table, f"the pose of {image.name}"))
                placed.append((table, image.world_from_camera[:3, 3]))
        problems += self.given.check(
            (name, image.path.stem) for instant in images.instants for name, image in instant.items()
        )
        return problems or check_extent(placed)

    def _scaled_points(self, path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        positions, colors = self.read_points(path)
        return self.scale * positions, colors


def _missing_points(table: PosedTable) -> list[Problem]:
    if table.points is None or table.points.is_file():
        return []
    message = f"the file is missing, which {table.path.name} names as that of its points"
    return [Problem(table.points, message, f"write it, or remove the entry of {table.path.name} that names it")]


def natural(key: object) -> list[tuple[int, float | int, str]]:
    """Orders names as people count: 2 before 10. A time is a number.

    >>> sorted(["b10", "b9", "a"], key=natural)
    ['a', 'b9', 'b10']
    """
    if isinstance(key, (float, int)):
        return [(0, key, "")]
    parts = re.split(r"(\d+)", str(key))
    return [(0, float(part), part) if place % 2 else (1, 0.0, part) for place, part in enumerate(parts)]


def _kind(image: PosedImage) -> tuple[str, Lens, tuple[int, int]]:
    return image.name.parent.as_posix(), image.lens, image.size


def _instant(image: PosedImage) -> object:
    return image.name.stem if image.time is None else image.time


def _camera_names(images: Sequence[PosedImage]) -> dict[tuple[str, Lens, tuple[int, int]], str]:
    """Kind of image -> camera: the folder's name, with a number where a folder has several lenses."""
    kinds = dict.fromkeys(_kind(image) for image in images)
    folders: dict[str, list[tuple[str, Lens, tuple[int, int]]]] = {}
    for kind in kinds:
        folders.setdefault(kind[0], []).append(kind)
    named = {}
    for folder, own in folders.items():
        base = "camera" if folder == "." else folder
        named |= {kind: base if len(own) == 1 else f"{base}_{number}" for number, kind in enumerate(own)}
    return named


def _masks(pixels: Pixels, shot: RecordedImage) -> dict[str, Bool[Tensor, "h w"]]:
    """Those that the data set and the user have; what either excludes is excluded."""
    assert isinstance(shot.key, PosedImage)
    camera, masks = pixels.rig[shot.camera], pixels.masks(shot)
    if shot.key.valid is None:
        return masks
    # The nearest pixel: between black and white nothing is valid in part.
    excluded = ~read_mask(shot.key.valid, camera.size, sky=True, undistortion=camera.undistortion)
    return masks | {"ego": masks["ego"] | excluded if "ego" in masks else excluded}


def _scaled(pose: Float64[Tensor, "4 4"], scale: float) -> Float64[Tensor, "4 4"]:
    scaled = pose.clone()
    scaled[:3, 3] *= scale
    return scaled


def _note_of_scale(shots: Sequence[RecordedImage], scale: float) -> str:
    first = [shot.world_from_camera[:3, 3] for shot in shots if shot.camera == shots[0].camera]
    length = float((torch.stack(first[1:]) - torch.stack(first[:-1])).norm(dim=-1).sum()) if len(first) > 1 else 0.0
    return (
        f"the unit of length is not known: one unit is read as {scale:g} m, so the first camera goes {length:.3g} m; "
        "data.log.scale says otherwise"
    )
