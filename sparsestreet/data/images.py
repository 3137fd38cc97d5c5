"""Images and masks, brought to the size that is asked for.

What a pixel means depends on its type (Pillow's mode). ``COLORS`` and ``LEVELS`` list the types that images and masks
may have; whatever is not listed is an error, because Pillow would convert it to white or black.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.problems import LogError, Problem, attempt, fault, missing_files
from sparsestreet.data.rig import Undistortion
from sparsestreet.types import MASK_KINDS, MaskSource

logger = logging.getLogger(__name__)

_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND\xae\x42\x60\x82"
_REMEDY = "write the file again from its source"
_TURN = "turn the pixels as the tag says and drop it, or calibrate for the pixels as they are stored"
_MASK_REMEDY = "write gray PNGs of two values, 0 and 255"
_ORIENTATION = 0x0112
_DEEP = ("I;16", "I;16L", "I;16B", "I;16N")
_WORDS = {"F": "32-bit floats", "I": "32-bit integers"}
_LOSSY = ("JPEG", "MPO", "WEBP", "JPEG2000")
_OUTER = 0.1
"""Of all levels, at either end: what a lossy encoder leaves of black and of white."""

WHITE = 250
"""Level of 255 from which a channel counts as cut off by the sensor: JPEG moves white by a few levels."""

T = TypeVar("T")


@dataclass(frozen=True)
class Header:
    """What a file says of its pixels; none is decoded."""

    size: tuple[int, int]
    """(width, height) as stored."""
    mode: str
    """Pillow's; I;16 for all grays of 16 bits."""
    deep: bool
    """Whether a channel has 16 bits."""
    alpha: bool
    orientation: int
    """EXIF's: 1 as stored, 2 to 8 mirrored or turned."""
    format: str

    @property
    def turned(self) -> bool:
        """Whether width and height change places as EXIF shows the image."""
        return self.orientation >= 5

    @staticmethod
    def of(image: Image.Image) -> "Header":
        """Of an image that is open and not loaded."""
        mode, deep = _type(image)
        return Header(image.size, mode, deep, image.has_transparency_data, _orientation(image), image.format or "")


def read_header(path: Path) -> Header:
    """Return what the file says of itself; raises LogError where that cannot be read."""
    return _opened(path, Header.of)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header; raises LogError where that cannot be read."""
    return _opened(path, lambda image: image.size)


def check_pixels(path: Path, *, decode: bool) -> None:
    """Raise LogError where the file cannot be decoded; without ``decode`` only what looks cut short is tried."""
    if decode or not path.is_file() or not _ends_well(path):
        _opened(path, partial(colors, path=path))


def check_camera_images(
    camera: str | int, images: Sequence[Path], masks: Iterable[Path], *, decode: bool
) -> list[Problem]:
    """Problems of a camera's images and masks: at the size of most of its images, of a type that is read, whole.

    Files that are missing are passed over; ``decode`` as in ``check_pixels``.
    """
    problems: list[Problem] = []
    headers = {path: attempt(problems, partial(read_header, path)) for path in images if path.is_file()}
    counts = Counter(header.size for header in headers.values() if header is not None)
    if not counts:
        return problems
    common = counts.most_common(1)[0][0]
    for path, header in headers.items():
        if header is None:
            continue
        if header.size != common:
            said = f"the others of camera {camera} are {common[0]}x{common[1]}"
            problems.append(_wrong_size(path, header, common, said, "write all images of a camera at one size"))
        elif header.format == "TIFF" and header.orientation > 1:
            problems.append(Problem(path, f"the TIFF carries orientation {header.orientation}", _TURN))
        elif attempt(problems, partial(_check_type, path, header.mode)):
            attempt(problems, partial(check_pixels, path, decode=decode))
    for path in masks:
        if path.is_file():
            attempt(problems, partial(check_mask, path, common, decode=decode))
    return problems


def check_image_sizes(camera: str | int, size: tuple[int, int], images: Sequence[Path]) -> list[Problem]:
    """A problem where the images of a camera have another (width, height) than its calibration; it names the first.

    Files that are missing or broken are passed over.
    """
    for path in filter(Path.is_file, images):
        header = attempt([], partial(read_header, path))
        if header is not None and header.size != size:
            said = f"camera {camera} is calibrated for {size[0]}x{size[1]}"
            return [_wrong_size(path, header, size, said, "read the images that the calibration was made with")]
    return []


def check_mask(path: Path, size: tuple[int, int], *, decode: bool) -> None:
    """Raise LogError for a mask of another (width, height), and if ``decode`` for pixels that are no mask."""
    found = image_size(path)
    if found != size:
        message = f"the mask is {found[0]}x{found[1]}, the camera's images are {size[0]}x{size[1]}"
        raise fault(path, message, "write masks at the size of the images")
    if decode or not _ends_well(path):
        _opened(path, partial(_split, path=path))


def image_notes(camera: str | int, images: Iterable[Path]) -> list[str]:
    """Say what is done with pixels of a camera that are no 8-bit colors as stored; only headers are read."""
    found: list[Header] = []
    for path in images:
        header = attempt([], partial(read_header, path))
        found += [header] if header else []
    turned = Counter(header.orientation for header in found if header.orientation > 1)
    deep, alpha = sum(header.deep for header in found), sum(header.alpha for header in found)
    notes = [
        f"{count} images of camera {camera} carry EXIF orientation {number}: read as stored, as COLMAP does"
        for number, count in sorted(turned.items())
    ]
    if deep:
        notes.append(f"{deep} images of camera {camera} have 16 bits a channel: 65535 is white, 8 bits are kept")
    if alpha:
        notes.append(
            f"{alpha} images of camera {camera} have alpha: pixels with less than half of it are not trained on and "
            "not measured"
        )
    return notes


def read_image(path: Path, size: tuple[int, int], undistortion: Undistortion | None = None) -> UInt8[Tensor, "h w 3"]:
    """RGB at (width, height), without the lens if told; raises LogError where the file cannot be decoded."""
    pixels = _resized(_opened(path, partial(colors, path=path)), size, Image.Resampling.BILINEAR)
    return torch.from_numpy(pixels if undistortion is None else undistortion(pixels))


def read_transparent(
    path: Path, size: tuple[int, int], undistortion: Undistortion | None = None
) -> Bool[Tensor, "h w"] | None:
    """Return pixels at (width, height) that one with less than half of alpha touches, without the lens if told; None
    where the file has no alpha. Raises LogError where it cannot be decoded."""
    alpha = _opened(path, _alpha)
    return None if alpha is None else _mask_at(alpha < 128, size, Image.Resampling.BILINEAR, undistortion)


def read_mask(
    path: Path, size: tuple[int, int], *, sky: bool, undistortion: Undistortion | None = None
) -> Bool[Tensor, "h w"]:
    """True where the file is not black, at (width, height); raises LogError where it cannot be decoded or is no mask.

    Sky takes the nearest pixel; other masks keep every pixel an object touches (DriveStudio: bilinear, then > 0).
    """
    mask = _opened(path, partial(_split, path=path))
    return _mask_at(mask, size, Image.Resampling.NEAREST if sky else Image.Resampling.BILINEAR, undistortion)


def joined(mask: Bool[Tensor, "h w"] | None, other: Bool[Tensor, "h w"] | None) -> Bool[Tensor, "h w"] | None:
    """Pixels of either mask; None where there is none."""
    return mask | other if mask is not None and other is not None else other if mask is None else mask


def colors(image: Image.Image, path: Path) -> Image.Image:
    """Return an open image as 8-bit RGB. Raises LogError for a type of pixels that is not read."""
    mode, _ = _type(image)
    _check_type(path, mode)
    return COLORS[mode](image)


def _type(image: Image.Image) -> tuple[str, bool]:
    """Pillow's mode of an image that is not loaded, one for all grays of 16 bits, and whether a channel has 16."""
    tiles = getattr(image, "tile", [])
    raw = str(tiles[0][3]) if tiles else ""
    deep = image.mode in _DEEP or "16" in raw
    return "I;16" if image.mode in _DEEP or (image.mode == "I" and deep) else image.mode, deep


def _check_type(path: Path, mode: str) -> bool:
    if mode in COLORS:
        return True
    words = f" ({_WORDS[mode]})" if mode in _WORDS else ""
    message = f"its pixels are of the type {mode}{words}, which is not read"
    raise fault(path, message, "write gray or RGB of 8 or 16 bits")


def _convert(image: Image.Image) -> Image.Image:
    return image.convert("RGB")


def _from_16_bits(image: Image.Image) -> Image.Image:
    gray = np.asarray(image).astype(np.int64)
    return Image.fromarray(((gray * 255 + 32767) // 65535).astype(np.uint8)).convert("RGB")


COLORS: dict[str, Callable[[Image.Image], Image.Image]] = {
    **dict.fromkeys(("1", "L", "P", "RGB", "RGBX", "CMYK", "YCbCr"), _convert),
    **dict.fromkeys(("LA", "PA", "RGBA"), _convert),  # alpha joins ego (read_transparent)
    "I;16": _from_16_bits,
}
"""Types of pixels of images -> how they become RGB."""


def _first(image: Image.Image) -> np.ndarray:
    """Of gray and alpha, or of an index and alpha."""
    pixels = np.asarray(image)
    return pixels if pixels.ndim == 2 else pixels[..., 0]


def _one_gray(image: Image.Image) -> np.ndarray:
    """Equal channels as one; of two colors with black, the other is white."""
    pixels = np.asarray(image)[..., :3]
    if (pixels == pixels[..., :1]).all():
        return pixels[..., 0]
    numbers = pixels.astype(np.int32) @ np.array([65536, 256, 1], np.int32)
    found = np.unique(numbers)
    if len(found) > 2 or found[0]:
        raise ValueError(f"the mask has {len(found)} colors, not black and one other")
    return np.where(numbers > 0, 255, 0).astype(np.uint8)


def _index(image: Image.Image) -> np.ndarray:
    """Numbers of a palette, whose colors mean nothing: many are all black."""
    found = _first(image)
    if not found.all() and tuple((image.getpalette("RGB") or [0])[:3]) == (255, 255, 255):
        raise ValueError("the mask's palette has white as number 0, which counts as black")
    return found


LEVELS: dict[str, Callable[[Image.Image], np.ndarray]] = {
    "1": lambda image: np.asarray(image.convert("L")),
    **dict.fromkeys(("L", "LA", "I;16"), _first),
    **dict.fromkeys(("P", "PA"), _index),
    **dict.fromkeys(("RGB", "RGBA"), _one_gray),
}
"""Types of pixels of masks -> how they become levels."""


def _split(image: Image.Image, path: Path) -> Bool[np.ndarray, "h w"]:
    """The pixels of a mask that are not black. Levels near black and white are split at the middle, which is logged
    once a folder. Raises LogError for what is no mask: more than two levels, colors, or an alpha that differs."""
    mode, _ = _type(image)
    if mode not in LEVELS:
        raise fault(path, f"the mask has pixels of the type {mode}, which is not read", _MASK_REMEDY)
    alpha = _alpha(image)
    if alpha is not None and alpha.min() != alpha.max():
        raise fault(path, "the mask has an alpha that differs from pixel to pixel, which is not read", _MASK_REMEDY)
    try:
        levels = LEVELS[mode](image)
    except ValueError as error:
        raise fault(path, str(error), _MASK_REMEDY) from error
    top = 65535 if mode == "I;16" else 255
    values = np.unique(levels) if top > 255 else np.flatnonzero(Image.fromarray(levels).histogram())
    if len(values) < 2 or (len(values) == 2 and not values[0]):
        return levels > 0
    low, high = (values <= _OUTER * top).sum(), (values >= (1 - _OUTER) * top).sum()
    # Of a label map the numbers are low, and a single one, 255, may stand for what has no label.
    if low + high < len(values) or not high or (high == 1 < low and image.format not in _LOSSY):
        some = ", ".join(map(str, values[:5])) + (", ..." if len(values) > 5 else "")
        raise fault(path, f"the mask has {len(values)} values ({some}), not black and one other", _MASK_REMEDY)
    _log_split(path.parent, path.name, len(values))
    return levels > top // 2


@lru_cache(maxsize=1024)
def _said(folder: Path) -> list[str]:
    """The first mask of a folder that was read by a guess."""
    return []


def _log_split(folder: Path, name: str, count: int) -> None:
    said = _said(folder)
    if not said:
        said.append(name)
        logger.warning(
            "masks such as %s have %d levels near black and white: they are split at the middle", folder / name, count
        )


def _alpha(image: Image.Image) -> UInt8[np.ndarray, "h w"] | None:
    if not image.has_transparency_data:
        return None
    if _type(image)[0] == "I;16":
        return np.where(np.asarray(image) == image.info["transparency"], 0, 255).astype(np.uint8)
    return np.asarray(image.convert("RGBA").getchannel("A"))


def _mask_at(
    mask: Bool[np.ndarray, "rows columns"],
    size: tuple[int, int],
    resampling: Image.Resampling,
    undistortion: Undistortion | None,
) -> Bool[Tensor, "h w"]:
    pixels = _resized(Image.fromarray(255 * mask.astype(np.uint8)), size, resampling)
    return torch.from_numpy((pixels if undistortion is None else undistortion(pixels)) > 0)


def _resized(pixels: Image.Image, size: tuple[int, int], resampling: Image.Resampling) -> np.ndarray:
    return np.array(pixels if size == pixels.size else pixels.resize(size, resampling))


def _orientation(image: Image.Image) -> int:
    if image.format == "PNG" and "exif" not in image.info:
        return 1  # Pillow would decode all pixels to look for a tag behind them
    try:
        found = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # the tags of a file are its own affair, and Pillow raises whatever it meets in broken ones
        return 1
    return found if found in range(1, 9) else 1


def _wrong_size(path: Path, header: Header, wanted: tuple[int, int], said: str, remedy: str) -> Problem:
    message = "the image is {}x{}, ".format(*header.size) + said
    if header.turned and header.size == wanted[::-1]:
        message += f"; its EXIF orientation {header.orientation} turns it, but pixels are read as they are stored"
        remedy = _TURN
    return Problem(path, message, remedy)


def _ends_well(path: Path) -> bool:
    """Whether the file ends as whole JPEG and PNG files do."""
    with path.open("rb") as file:
        file.seek(-min(len(_PNG_END), path.stat().st_size), os.SEEK_END)
        return file.read().endswith((_JPEG_END, _PNG_END))


def _opened(path: Path, read: Callable[[Image.Image], T]) -> T:
    """What ``read`` makes of the file. Raises LogError where it cannot be decoded."""
    try:
        check_regular(path)
        with Image.open(path) as image:
            return read(image)
    except LogError:
        raise
    except UnidentifiedImageError as error:
        message = "the image cannot be decoded (no format or type of pixels that Pillow knows)"
        raise fault(path, message, "write gray or RGB of 8 or 16 bits as PNG or JPEG") from error
    # Pillow reports a broken PNG chunk as SyntaxError.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise fault(path, f"the image cannot be decoded ({error})", _REMEDY) from error


def jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    """RGB, 4:4:4, because halved color would smear edges, for which a small image has few pixels."""
    file = BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=0)
    return file.getvalue()


def png(pixels: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """RGB or gray, without loss."""
    file = BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def mask_png(mask: Bool[np.ndarray, "h w"]) -> bytes:
    """White where the mask is true."""
    return png(mask.astype(np.uint8) * 255)


def number_lines(numbers: Float[np.ndarray, "..."] | Sequence[float]) -> bytes:
    """Rows of a matrix, or a number a line, with all digits of float64."""
    file = BytesIO()
    np.savetxt(file, numbers)
    return file.getvalue()


@dataclass(frozen=True)
class GivenMasks:
    """PNGs ``KIND/CAMERA/STEM.png``, white where the kind is, at the size of the recorded images.

    A camera without a folder has no masks of the kind; one with a folder has them for all of its images.
    """

    root: Path | None
    """None: nobody made any."""

    @property
    def kinds(self) -> frozenset[str]:
        root = self.root
        return frozenset(() if root is None else (kind for kind in MASK_KINDS if (root / kind).is_dir()))

    def beside(self, shipped: Iterable[str]) -> dict[str, MaskSource]:
        """Return kind -> whose masks they are; ``shipped``: kinds of the data set itself, which given ones replace."""
        return {**dict.fromkeys(shipped, "shipped"), **dict.fromkeys(self.kinds, "given")}

    def paths(self, camera: str, stem: str) -> dict[str, Path]:
        """Kind -> the file of an image, for the kinds that its camera has."""
        folders = {} if self.root is None else {kind: self.root / kind / camera for kind in MASK_KINDS}
        return {kind: folder / f"{stem}.png" for kind, folder in folders.items() if folder.is_dir()}

    def read(
        self,
        camera: str,
        stem: str,
        *,
        recorded_size: tuple[int, int],
        size: tuple[int, int],
        undistortion: Undistortion | None = None,
    ) -> dict[str, Bool[Tensor, "h w"]]:
        """Kind -> mask at ``size``, both (width, height), without the lens if told.

        Raises LogError for a file that is missing or broken.
        """
        masks = {}
        for kind, path in self.paths(camera, stem).items():
            if not path.is_file():
                raise fault(path, "the mask is missing", "write a mask for every image, or remove the camera's folder")
            if (found := image_size(path)) != recorded_size:
                message = "the mask is {}x{}, the camera's images are {}x{}".format(*found, *recorded_size)
                raise fault(path, message, "write masks at the size of the recorded images")
            masks[kind] = read_mask(path, size, sky=kind == "sky", undistortion=undistortion)
        return masks

    def check(self, images: Iterable[tuple[str, str]]) -> list[Problem]:
        """What is missing for some images, each a camera and a stem."""
        if self.root is not None and not self.kinds:
            message = f"it holds none of the folders {', '.join(MASK_KINDS)}"
            return [Problem(self.root, message, "name the folder that holds them (data.log.masks), or null")]
        return missing_files(path for camera, stem in images for path in self.paths(camera, stem).values())
