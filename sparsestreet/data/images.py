"""Images and masks, brought to the size that is asked for."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, Problem, attempt, fault
from sparsestreet.data.undistortion import Undistortion

_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND\xae\x42\x60\x82"
_REMEDY = "write the file again from its source"


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header; raises LogError where that cannot be read."""
    try:
        check_regular(path)
        with Image.open(path) as image:
            return image.size
    except (OSError, Image.DecompressionBombError) as error:
        raise _unreadable(path, error) from error


def check_pixels(path: Path, *, decode: bool) -> None:
    """Raises LogError where the file cannot be decoded; without ``decode`` only what looks cut short is tried."""
    if decode or not path.is_file() or not _ends_well(path):
        _decode(path, "RGB", None, Image.Resampling.NEAREST)


def check_camera_images(
    camera: str | int, images: Sequence[Path], masks: Iterable[Path], *, decode: bool
) -> list[Problem]:
    """Problems of a camera's images and masks: all at the size of most of its images, and whole.

    Files that are missing are passed over; ``decode`` as in ``check_pixels``.
    """
    problems: list[Problem] = []
    sizes = {path: attempt(problems, partial(image_size, path)) for path in images if path.is_file()}
    counts = Counter(size for size in sizes.values() if size is not None)
    if not counts:
        return problems
    common = counts.most_common(1)[0][0]
    for path, size in sizes.items():
        if size is not None and size != common:
            message = f"the image is {size[0]}x{size[1]}, the others of camera {camera} are {common[0]}x{common[1]}"
            problems.append(Problem(path, message, "write all images of a camera at one size"))
        elif size is not None:
            attempt(problems, partial(check_pixels, path, decode=decode))
    for path in masks:
        if path.is_file():
            attempt(problems, partial(_check_mask, path, common, decode))
    return problems


def check_image_sizes(camera: str | int, size: tuple[int, int], images: Sequence[Path]) -> list[Problem]:
    """A problem where the images of a camera have another (width, height) than its calibration; it names the first.

    Files that are missing or broken are passed over.
    """
    for path in filter(Path.is_file, images):
        found = attempt([], partial(image_size, path))
        if found is not None and found != size:
            message = "the image is {}x{}, camera {} is calibrated for {}x{}".format(*found, camera, *size)
            return [Problem(path, message, "read the images that the calibration was made with")]
    return []


def _check_mask(path: Path, size: tuple[int, int], decode: bool) -> None:
    found = image_size(path)
    if found != size:
        message = f"the mask is {found[0]}x{found[1]}, the camera's images are {size[0]}x{size[1]}"
        raise fault(path, message, "write masks at the size of the images")
    check_pixels(path, decode=decode)


def _ends_well(path: Path) -> bool:
    """Whether the file ends as whole JPEG and PNG files do."""
    with path.open("rb") as file:
        file.seek(-min(len(_PNG_END), path.stat().st_size), os.SEEK_END)
        return file.read().endswith((_JPEG_END, _PNG_END))


def read_image(path: Path, size: tuple[int, int], undistortion: Undistortion | None = None) -> UInt8[Tensor, "h w 3"]:
    """RGB at (width, height), without the lens if told; raises LogError where the file cannot be decoded."""
    pixels = _decode(path, "RGB", size, Image.Resampling.BILINEAR)
    return torch.from_numpy(pixels if undistortion is None else undistortion(pixels))


def read_mask(
    path: Path, size: tuple[int, int], *, sky: bool, undistortion: Undistortion | None = None
) -> Bool[Tensor, "h w"]:
    """True where the file is not black, at (width, height); raises LogError where it cannot be decoded.

    Sky takes the nearest pixel; other masks keep every pixel an object touches (DriveStudio: bilinear, then > 0).
    """
    pixels = _decode(path, "L", size, Image.Resampling.NEAREST if sky else Image.Resampling.BILINEAR)
    return torch.from_numpy((pixels if undistortion is None else undistortion(pixels)) > 0)


def _decode(path: Path, mode: str, size: tuple[int, int] | None, resampling: Image.Resampling) -> np.ndarray:
    try:
        check_regular(path)
        with Image.open(path) as image:
            pixels = image.convert(mode)
        return np.array(pixels if size in (None, pixels.size) else pixels.resize(size, resampling))
    # Pillow reports a broken PNG chunk as SyntaxError.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> LogError:
    return fault(path, f"the image cannot be decoded ({error})", _REMEDY)
