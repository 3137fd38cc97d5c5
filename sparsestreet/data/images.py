"""Images and masks, brought to the size that is asked for."""

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from torch import Tensor

from sparsestreet.data.problems import LogError, fault

_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND\xae\x42\x60\x82"
_REMEDY = "write the file again from its source"


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header; raises LogError where that cannot be read."""
    try:
        with Image.open(path) as image:
            return image.size
    except OSError as error:
        raise _unreadable(path, error) from error


def check_pixels(path: Path, *, decode: bool) -> None:
    """Raises LogError where the file cannot be decoded; without ``decode`` only what looks cut short is tried."""
    if decode or not _ends_well(path):
        _decode(path, "RGB", None, Image.Resampling.NEAREST)


def _ends_well(path: Path) -> bool:
    """Whether the file ends as whole JPEG and PNG files do."""
    with path.open("rb") as file:
        file.seek(-min(len(_PNG_END), path.stat().st_size), os.SEEK_END)
        return file.read().endswith((_JPEG_END, _PNG_END))


def read_image(path: Path, size: tuple[int, int]) -> UInt8[Tensor, "h w 3"]:
    """RGB at (width, height); raises LogError where the file cannot be decoded."""
    return torch.from_numpy(_decode(path, "RGB", size, Image.Resampling.BILINEAR))


def read_mask(path: Path, size: tuple[int, int], *, sky: bool) -> Bool[Tensor, "h w"]:
    """True where the file is not black, at (width, height); raises LogError where it cannot be decoded.

    Sky takes the nearest pixel; other masks keep every pixel an object touches (DriveStudio: bilinear, then > 0).
    """
    resampling = Image.Resampling.NEAREST if sky else Image.Resampling.BILINEAR
    return torch.from_numpy(_decode(path, "L", size, resampling) > 0)


def _decode(path: Path, mode: str, size: tuple[int, int] | None, resampling: Image.Resampling) -> np.ndarray:
    try:
        with Image.open(path) as image:
            pixels = image.convert(mode)
        return np.array(pixels if size in (None, pixels.size) else pixels.resize(size, resampling))
    except (OSError, SyntaxError, ValueError) as error:  # Pillow reports a broken PNG chunk as SyntaxError
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> LogError:
    return fault(path, f"the image cannot be decoded ({error})", _REMEDY)
