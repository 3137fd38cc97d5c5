"""``predictions/<split>/FFF_C.png``: what a run shows of its views, kept so that anybody can compute numbers from it.

16-bit RGB PNGs of the clamped renders: value = round(65535 x), at most 7.7e-6 away from x. Pillow knows no such PNGs,
so OpenCV reads and writes them.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt16

from sparsestreet.atomic import atomic_file

LEVELS = 65535


class PredictionError(ValueError):
    """A stored prediction that cannot be read; names the file and the remedy."""


@dataclass(frozen=True)
class Predictions:
    """The predictions of some views, one file each."""

    folder: Path

    @classmethod
    def of(cls, run: Path, split: str) -> "Predictions":
        """Those that a run keeps of the views of a split."""
        return cls(run / "predictions" / split)

    def path(self, frame: int, camera: int) -> Path:
        """The file of one view."""
        return self.folder / f"{frame:03d}_{camera}.png"

    def clear(self) -> None:
        """Remove those of an earlier evaluation, perhaps of other views; files of other names stay."""
        for path in self.folder.glob("[0-9]*_[0-9]*.png"):
            path.unlink()

    def write(self, frame: int, camera: int, pixels: UInt16[np.ndarray, "h w 3"]) -> None:
        """Write one, the whole file or nothing. Raises OSError where it cannot be written."""
        path = self.path(frame, camera)
        with atomic_file(path) as temporary:
            # OpenCV's order is BGR. Of 16 bits the lower are noise, which no effort compresses.
            done, data = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if not done:
                raise OSError(f"{path}: an image of shape {pixels.shape} cannot be encoded as PNG")
            temporary.write_bytes(data.tobytes())

    def read(self, frame: int, camera: int) -> UInt16[np.ndarray, "h w 3"]:
        """Read one back. Raises PredictionError for a file that is absent, damaged or no 16-bit RGB PNG."""
        path = self.path(frame, camera)
        if not path.is_file():
            raise PredictionError(f"{path} is not there: evaluate the run, which stores its predictions")
        try:
            pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:  # an empty file, or a header of more pixels than OpenCV reads
            pixels = None
        if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] != 3:
            found = "cannot be decoded" if pixels is None else f"is {pixels.dtype} of shape {pixels.shape}"
            raise PredictionError(f"{path} {found}, a prediction is a 16-bit RGB PNG: evaluate the run again")
        return np.ascontiguousarray(pixels[..., ::-1])


def quantized(image: Float[np.ndarray, "h w 3"]) -> UInt16[np.ndarray, "h w 3"]:
    """Values in [0, 1] as a prediction holds them."""
    return np.round(image.astype(np.float64) * LEVELS).astype(np.uint16)


def restored(pixels: UInt16[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """What a prediction holds as float32 in [0, 1]."""
    return (pixels / LEVELS).astype(np.float32)
