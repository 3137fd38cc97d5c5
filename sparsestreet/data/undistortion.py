"""Takes a lens out of images: what a pinhole with the same intrinsics would have recorded."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.distortion import distort


@dataclass(frozen=True)
class Undistortion:
    """For each pixel center of the pinhole's image, the place in the recorded image that shows the same direction."""

    columns: Float[np.ndarray, "h w"]
    """Counted from the center of the first pixel, as OpenCV does."""
    rows: Float[np.ndarray, "h w"]

    @staticmethod
    def of(intrinsics: Float[Tensor, "3 3"], distortion: Float[Tensor, "5"], width: int, height: int) -> "Undistortion":
        """K distort(K^-1 p) of all pixel centers p, which lie at +0.5 (``geometry.distortion`` has the formula).

        OpenCV's ``undistort`` is the same for a principal point that is counted from the first pixel's center.
        """
        (fx, _, cx), (_, fy, cy), _ = intrinsics.double().tolist()
        x = (torch.arange(width, dtype=torch.float64) + 0.5 - cx) / fx
        y = (torch.arange(height, dtype=torch.float64) + 0.5 - cy) / fy
        shown = distort(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1), distortion.double())
        columns, rows = fx * shown[..., 0] + cx - 0.5, fy * shown[..., 1] + cy - 0.5
        return Undistortion(columns.float().numpy(), rows.float().numpy())

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Returns an image or a mask [h, w, ...] without the lens, interpolated bilinearly.

        What the camera did not record is black.
        """
        return cv2.remap(pixels, self.columns, self.rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
