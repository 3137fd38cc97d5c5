"""The cameras of a rig: what is the same in all images of one, and what becomes of its lens."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from sparsestreet.data.problems import fault
from sparsestreet.geometry.cameras import inverse
from sparsestreet.geometry.lenses import BrownConrady, Lens, largest_shift
from sparsestreet.types import Camera

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

        For Brown-Conrady and the same intrinsics it is K distort(K^-1 p) (``geometry.lenses`` has the formula).
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
        """Return an image or a mask [h, w, ...] without the lens, interpolated bilinearly.

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


Name = TypeVar("Name", str, int)

_WORTH_RESAMPLING = 0.5
"""Pixels that a lens of another model must move some pixel by to be taken out: to resample an image blurs all of it."""
_WIDEST_PINHOLE = 170.0
"""Degrees. At its border such a pinhole has 130 times as many pixels for a small angle as at its center."""


@dataclass(frozen=True)
class RigCamera(Generic[Name]):
    """What is the same in all images of a camera."""

    name: Name
    """As the data set calls it."""
    index: int
    """As the log counts it."""
    intrinsics: Float[Tensor, "3 3"]
    size: tuple[int, int]
    """(width, height) of the images as they are read, pixels; without their lens too."""
    distortion: Float[Tensor, "5"] | None
    """Of the lens that its images show; None: they are a pinhole's."""
    note: str | None
    """What becomes of the lens, where the camera has one."""
    undistortion: Undistortion | None = None
    """Takes a lens out of images and masks at ``size``; None: they are as recorded."""

    def at(self, world_from_camera: Float64[Tensor, "4 4"]) -> Camera:
        """The camera at a pose of the log's world."""
        return Camera(inverse(world_from_camera).float(), self.intrinsics, *self.size, self.distortion)

    def not_of_the_street(self, ego: Bool[Tensor, "h w"] | None) -> Bool[Tensor, "h w"] | None:
        """The mask of the recording car and of what the lens did not record, which is black without it; None: none."""
        blank = None if self.undistortion is None else self.undistortion.blank
        if ego is None or blank is None:
            return blank if ego is None else ego
        return blank | ego


def rig_camera(
    name: Name,
    index: int,
    *,
    intrinsics: Float64[Tensor, "3 3"],
    distortion: Float64[Tensor, "5"],
    recorded_size: tuple[int, int],
    width: int | None = None,
    undistort: bool = False,
) -> RigCamera[Name]:
    """Size after scaling, and intrinsics scaled per axis with it: pixel centers lie at +0.5, so cx and cy scale too.

    Args:
        name: as the data set calls the camera.
        index: as the log counts it.
        intrinsics: pixels of the recorded images.
        distortion: Brown-Conrady k1, k2, p1, p2, k3 as OpenCV orders them; zeros for a pinhole.
        recorded_size: (width, height) of the recorded images.
        width: to which images are scaled, the height in proportion; None: as recorded.
        undistort: whether every lens is taken out of the images.

    Raises ValueError for a width that the images do not have.
    """
    size = _scaled_size(name, recorded_size, width)
    intrinsics = _scaled(intrinsics, recorded_size, size)
    lens, note, undistortion = None, None, None
    if distortion.any():
        shift = largest_shift(intrinsics, distortion, *size)
        if undistort:
            undistortion = Undistortion.of(BrownConrady.of(intrinsics, distortion), intrinsics, size, size)
            note = f"camera {name}: its lens, which moves pixels by up to {shift:.3g}, is taken out of the images"
        else:
            lens, note = distortion.float(), f"camera {name}: its lens moves pixels by up to {shift:.3g}"
    return RigCamera(name, index, intrinsics.float(), size, lens, note, undistortion)


def lens_camera(
    name: Name,
    index: int,
    *,
    lens: Lens,
    recorded_size: tuple[int, int],
    width: int | None = None,
    pinhole_fov: float | None = None,
    undistort: bool = False,
) -> RigCamera[Name]:
    """As ``rig_camera``, of a camera with a lens of any model. What the splat op cannot simulate is taken out.

    Images and masks are then resampled, at their size, to a pinhole. By default it has the lens's resolution at the
    center, so that nothing there is blurred or thinned out, and a wide lens loses what lies far outside.

    Args:
        name: as the data set calls the camera.
        index: as the log counts it.
        lens: in pixels of the recorded images.
        recorded_size: (width, height) of the recorded images.
        width: as in ``rig_camera``.
        pinhole_fov: degrees that the pinhole sees from its left to its right edge; None: by the resolution.
        undistort: as in ``rig_camera``, of a lens that could be simulated.

    Raises ValueError for a width or an angle that cannot be.
    """
    brown_conrady = lens.brown_conrady()
    if brown_conrady is not None:
        return rig_camera(
            name,
            index,
            intrinsics=lens.pinhole,
            distortion=brown_conrady,
            recorded_size=recorded_size,
            width=width,
            undistort=undistort,
        )
    size = _scaled_size(name, recorded_size, width)
    intrinsics = _scaled(lens.pinhole, recorded_size, size)
    if pinhole_fov is not None:
        intrinsics = _seeing(intrinsics, size[0], pinhole_fov)
    undistortion = Undistortion.of(lens, intrinsics, size, recorded_size)
    shift = undistortion.largest_shift
    if pinhole_fov is None and shift < _WORTH_RESAMPLING:
        note = f"camera {name}: its lens ({type(lens).__name__}) moves pixels by at most {shift:.3g} and is left out"
        return RigCamera(name, index, intrinsics.float(), size, None, note)
    return RigCamera(
        name, index, intrinsics.float(), size, None, _resampling(name, lens, intrinsics, undistortion), undistortion
    )


def check_lens_camera(path: Path, lens: Lens, size: tuple[int, int]) -> None:
    """As ``check_lens``, for a lens of any model."""
    brown_conrady = lens.brown_conrady()
    if brown_conrady is not None:
        check_lens(path, lens.pinhole, brown_conrady, size)
        return
    try:
        lens.check(*size)
    except ValueError as error:
        raise fault(path, str(error), "write the coefficients of the calibration, by the model's own names") from error


def check_lens(
    path: Path, intrinsics: Float64[Tensor, "3 3"], distortion: Float64[Tensor, "5"], size: tuple[int, int]
) -> None:
    """Raise LogError, naming the file of the calibration, unless the lens has an inverse everywhere in the image."""
    if not distortion.any():
        return
    try:
        largest_shift(intrinsics, distortion, *size)
    except ValueError as error:
        message = f"the lens k1 k2 p1 p2 k3 = {distortion.tolist()} images nothing in parts of the image: no inverse"
        remedy = "write the coefficients of the calibration, in OpenCV's order; zeros for images without distortion"
        raise fault(path, message, remedy) from error


def _scaled_size(name: str | int, recorded_size: tuple[int, int], width: int | None) -> tuple[int, int]:
    full_width, full_height = recorded_size
    if width is not None and not 0 < width <= full_width:
        raise ValueError(f"width must be within 1 to {full_width}, the images of camera {name}, got {width}")
    return (full_width, full_height) if width is None else (width, max(1, round(full_height * width / full_width)))


def _scaled(
    intrinsics: Float64[Tensor, "3 3"], recorded_size: tuple[int, int], size: tuple[int, int]
) -> Float64[Tensor, "3 3"]:
    scale = torch.tensor([size[0] / recorded_size[0], size[1] / recorded_size[1], 1.0], dtype=torch.float64)
    return scale[:, None] * intrinsics


def _seeing(intrinsics: Float64[Tensor, "3 3"], width: int, degrees: float) -> Float64[Tensor, "3 3"]:
    """The pinhole zoomed to this field of view, around the middle column; pixels keep their aspect."""
    if not 0 < degrees < _WIDEST_PINHOLE:
        raise ValueError(f"pinhole_fov must lie within 0 and {_WIDEST_PINHOLE:g} degrees, got {degrees:g}: take 100")
    focal = width / 2 / math.tan(math.radians(degrees) / 2)
    zoomed = intrinsics.clone()
    zoomed[0, 2] = width / 2
    zoomed[0, 0], zoomed[1, 1] = focal, focal * intrinsics[1, 1] / intrinsics[0, 0]
    return zoomed


def _resampling(name: str | int, lens: Lens, intrinsics: Float64[Tensor, "3 3"], undistortion: Undistortion) -> str:
    """What a user must know about a lens that is taken out."""
    width = undistortion.columns.shape[1]
    (fx, _, cx), _, _ = intrinsics.tolist()
    degrees = math.degrees(math.atan(cx / fx) + math.atan((width - cx) / fx))
    blank = 0.0 if undistortion.blank is None else float(undistortion.blank.double().mean())
    return (
        f"camera {name}: its lens ({type(lens).__name__}) is none that is simulated; its images are resampled to a "
        f"pinhole of {degrees:.0f} degrees, outside of which lie {undistortion.lost:.1%} of the recorded pixels; "
        f"nothing was recorded for {blank:.1%} of its own, which no loss sees"
    )
