"""The cameras of a rig: what is the same in all images of one, and whether its lens is simulated."""

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.problems import fault
from sparsestreet.data.undistortion import Undistortion
from sparsestreet.geometry.distortion import largest_shift
from sparsestreet.geometry.transforms import inverse
from sparsestreet.types import Camera

Name = TypeVar("Name", str, int)


@dataclass(frozen=True)
class RigCamera(Generic[Name]):
    """What is the same in all images of a camera."""

    name: Name
    """As the data set calls it."""
    index: int
    """As the log counts it."""
    intrinsics: Float[Tensor, "3 3"]
    size: tuple[int, int]
    """(width, height) of the images as they are read, pixels."""
    distortion: Float[Tensor, "5"] | None
    """Of a lens that is simulated."""
    note: str | None
    """What becomes of the lens, where the camera has one."""
    undistortion: Undistortion | None = None
    """Takes a lens out of images and masks at ``size``; None: they are as recorded."""

    def at(self, world_from_camera: Float64[Tensor, "4 4"]) -> Camera:
        """The camera at a pose of the log's world."""
        return Camera(inverse(world_from_camera).float(), self.intrinsics, *self.size, self.distortion)


def rig_camera(
    name: Name,
    index: int,
    *,
    intrinsics: Float64[Tensor, "3 3"],
    distortion: Float64[Tensor, "5"],
    recorded_size: tuple[int, int],
    width: int | None = None,
    min_lens_shift: float | None = 0.5,
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
        min_lens_shift: a lens that moves some pixel, of the images as they are read, by at least this many is
            simulated; 0: every lens, None: none.
        undistort: whether every lens is taken out of the images instead, and none is simulated.

    Raises ValueError for a width that the images do not have.
    """
    full_width, full_height = recorded_size
    if width is not None and not 0 < width <= full_width:
        raise ValueError(f"width must be within 1 to {full_width}, the images of camera {name}, got {width}")
    size = (full_width, full_height) if width is None else (width, max(1, round(full_height * width / full_width)))
    scale = torch.tensor([size[0] / full_width, size[1] / full_height, 1.0], dtype=torch.float64)
    intrinsics = scale[:, None] * intrinsics
    simulated, note, undistortion = False, None, None
    if distortion.any():
        shift = largest_shift(intrinsics, distortion, *size)
        if undistort:
            undistortion = Undistortion.of(intrinsics, distortion, *size)
            note = f"camera {name}: its lens, which moves pixels by up to {shift:.3g}, is taken out of the images"
        else:
            simulated, note = _lens_decision(name, shift, min_lens_shift)
    lens = distortion.float() if simulated else None
    return RigCamera(name, index, intrinsics.float(), size, lens, note, undistortion)


def check_lens(
    path: Path, intrinsics: Float64[Tensor, "3 3"], distortion: Float64[Tensor, "5"], size: tuple[int, int]
) -> None:
    """Raises LogError, naming the file of the calibration, unless the lens has an inverse everywhere in the image."""
    if not distortion.any():
        return
    try:
        largest_shift(intrinsics, distortion, *size)
    except ValueError as error:
        message = f"the lens k1 k2 p1 p2 k3 = {distortion.tolist()} images nothing in parts of the image: no inverse"
        remedy = "write the coefficients of the calibration, in OpenCV's order; zeros for images without distortion"
        raise fault(path, message, remedy) from error


def _lens_decision(name: str | int, shift: float, min_lens_shift: float | None) -> tuple[bool, str]:
    """Whether a lens that moves pixels by up to ``shift`` is simulated, and a sentence that says so."""
    lens = f"camera {name}: its lens"
    if min_lens_shift is None:
        return False, f"{lens}, which moves pixels by up to {shift:.3g}, is ignored, as asked"
    if shift < min_lens_shift:
        return False, f"{lens} moves pixels by at most {shift:.3g} and is left out (data.log.min_lens_shift)"
    return True, f"{lens} moves pixels by up to {shift:.3g} and is simulated"
