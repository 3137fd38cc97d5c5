"""Masks from the labels of KITTI-360's images."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from PIL import Image
from torch import Tensor

from sparsestreet.atomic import check_regular
from sparsestreet.data.kitti.contents import check_size
from sparsestreet.data.problems import fault

KINDS = {"sky": (23,), "human": (24, 25, 32, 33), "vehicle": (26, 27, 28, 29, 30, 31)}
"""Class numbers of the label images. Two-wheelers are of the kind human, as in DriveStudio's masks: person, rider,
motorcycle, bicycle; car, truck, bus, caravan, trailer, train."""


def read_semantics(path: Path, recorded_size: tuple[int, int], size: tuple[int, int]) -> dict[str, Bool[Tensor, "h w"]]:
    """Kind -> mask at (width, height) ``size``, of the nearest pixels; raises LogError for a broken label image."""
    check_size(path, recorded_size)
    try:
        check_regular(path)
        with Image.open(path) as image:
            if image.mode not in ("L", "P"):
                message = f"a label image has one number of 8 bits a pixel, this has the mode {image.mode}"
                raise fault(path, message, "copy it again from the published archive")
            labels = np.array(image.resize(size, Image.Resampling.NEAREST))
    except (OSError, SyntaxError) as error:  # Pillow reports a broken PNG chunk as SyntaxError
        raise fault(path, f"the labels cannot be decoded ({error})", "copy them again, or remove them") from error
    return {kind: torch.from_numpy(np.isin(labels, numbers)) for kind, numbers in KINDS.items()}
