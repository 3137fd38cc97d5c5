"""Takes a lens out of images: what a pinhole would have recorded."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.geometry.lenses import Lens

_OUTSIDE = -2.0
"""A column or row from which no weight of the bilinear interpolation falls into the image."""
_EDGE = 1 / 64
"""Pixels beyond the centers of the outermost pixels that still count as recorded: OpenCV rounds places to a 32nd."""


@dataclass(frozen=True)
class Undistortion:
    """For each pixel center of the pinhole's image, the place in the recorded image that shows the same direction."""

    columns: Float[np.ndarray, "h w"]
    """Counted from the center of the first pixel, as OpenCV does; -2 where the lens images nothing."""
    rows: Float[np.ndarray, "h w"]

    @staticmethod
    def of(
        lens: Lens, intrinsics: Float64[Tensor, "3 3"], size: tuple[int, int], recorded_size: tuple[int, int]
    ) -> "Undistortion":
        """Where the lens shows what each pixel center of a pinhole sees.

        For Brown-Conrady and the same intrinsics it is K distort(K^-1 p) (``geometry.distortion`` has the formula).
        OpenCV's ``undistort`` is the same for a principal point that is counted from the first pixel's center.

        Args:
            lens: that the images were recorded through.
            intrinsics: of the pinhole.
            size: (width, height) of the pinhole's images, and of those that it is made from.
            recorded_size: (width, height) that the lens is calibrated for; images are scaled from it to ``size``.
        """
        (width, height), (full_width, full_height) = size, recorded_size
        shown = lens.project(_rays(intrinsics, width, height))
        columns, rows = (width / full_width) * shown[..., 0] - 0.5, (height / full_height) * shown[..., 1] - 0.5
        places = (torch.where(place.isfinite(), place, _OUTSIDE).float().numpy() for place in (columns, rows))
        return Undistortion(*places)

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Returns an image or a mask [h, w, ...] without the lens, interpolated bilinearly.

        What the camera did not record is black.
        """
        return cv2.remap(pixels, self.columns, self.rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    @cached_property
    def blank(self) -> Bool[Tensor, "h w"] | None:
        """Pixels of the pinhole that hold something else than what was recorded: black, all or in part. None: none."""
        height, width = self.columns.shape
        in_columns = (self.columns >= -_EDGE) & (self.columns <= width - 1 + _EDGE)
        recorded = in_columns & (self.rows >= -_EDGE) & (self.rows <= height - 1 + _EDGE)
        return None if recorded.all() else torch.from_numpy(~recorded)

    @property
    def lost(self) -> float:
        """Share of the recorded pixels that the pinhole does not show: 1 less the summed areas, in recorded pixels, of
        its own."""
        height, width = self.columns.shape
        if min(height, width) < 2:
            return 0.0
        columns, rows = (np.where(place == _OUTSIDE, np.nan, place) for place in (self.columns, self.rows))
        (column_down, column_right), (row_down, row_right) = np.gradient(columns), np.gradient(rows)
        areas = np.abs(column_right * row_down - column_down * row_right)
        inside = (columns > -0.5) & (columns < width - 0.5) & (rows > -0.5) & (rows < height - 0.5)
        return float(np.clip(1 - np.nansum(areas[inside], dtype=np.float64) / (width * height), 0, 1))

    @property
    def largest_shift(self) -> float:
        """The largest distance between a pixel of the pinhole and its place in the image, where there is one."""
        height, width = self.columns.shape
        shift = np.hypot(self.columns - np.arange(width), self.rows - np.arange(height)[:, None])
        return float(shift[self.columns != _OUTSIDE].max(initial=0.0))


def _rays(intrinsics: Float64[Tensor, "3 3"], width: int, height: int) -> Float64[Tensor, "h w 3"]:
    """Directions (x, y, 1) through the pixel centers, which lie at +0.5."""
    (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - cy) / fy
    x, y = torch.meshgrid(x, y, indexing="xy")
    return torch.stack((x, y, torch.ones_like(x)), -1)
