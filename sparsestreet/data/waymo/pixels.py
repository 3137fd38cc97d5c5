"""Images and masks from the bytes of PNG and JPEG files that stand in other files."""

import io
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from torch import Tensor

from sparsestreet.data.images import colors
from sparsestreet.data.problems import LogError, fault
from sparsestreet.data.waymo.segment import REMEDY

_KINDS = {"sky": (25,), "human": (6, 7, 9, 10, 11), "vehicle": (2, 3, 4, 5, 8)}
"""Of Waymo's 28 classes: bicycles and motorcycles count as human, as in DriveStudio's masks."""


def decode_image(
    data: bytes, recorded: tuple[int, int], size: tuple[int, int], path: Path, what: str
) -> UInt8[Tensor, "h w 3"]:
    """RGB at ``size``; raises LogError for bytes that are no image of ``recorded`` (width, height)."""
    pixels = _opened(data, recorded, path, what, "RGB")
    return torch.from_numpy(np.array(pixels if size == recorded else pixels.resize(size, Image.Resampling.BILINEAR)))


def decode_masks(
    data: bytes, divisor: int, recorded: tuple[int, int], size: tuple[int, int], path: Path, what: str
) -> dict[str, Bool[Tensor, "h w"]]:
    """Kind -> mask at ``size``, from a PNG of class * divisor + instance. Raises as ``decode_image``.

    Sky takes the nearest pixel; other masks keep every pixel that an object touches, as those of files do.
    """
    if divisor <= 0:
        raise fault(path, f"{what} has the divisor {divisor}", REMEDY)
    classes = np.array(_opened(data, recorded, path, what, None)).astype(np.int32) // divisor
    masks = {}
    for kind, members in _KINDS.items():
        mask = 255 * np.isin(classes, members, kind="table").astype(np.uint8)
        if size != recorded:
            way = Image.Resampling.NEAREST if kind == "sky" else Image.Resampling.BILINEAR
            mask = np.array(Image.fromarray(mask).resize(size, way))
        masks[kind] = torch.from_numpy(mask > 0)
    return masks


def _opened(data: bytes, recorded: tuple[int, int], path: Path, what: str, mode: str | None) -> Image.Image:
    """The size is compared before a pixel is decoded."""
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if image.size != recorded:
                found = f"{image.size[0]}x{image.size[1]}"
                raise fault(path, f"{what} is {found}, its calibration is for {recorded[0]}x{recorded[1]}", REMEDY)
            if mode is None and image.mode not in ("I;16", "I", "L"):
                raise fault(path, f"{what} has pixels of the kind {image.mode}, not one number each", REMEDY)
            return image.copy() if mode is None else colors(image, path)
    except LogError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise fault(path, f"{what} cannot be decoded ({error})", REMEDY) from error
