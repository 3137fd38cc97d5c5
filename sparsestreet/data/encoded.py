"""Images, masks and numbers as the bytes of files; equal content gives equal bytes."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image


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
