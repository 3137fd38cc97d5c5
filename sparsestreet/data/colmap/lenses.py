"""COLMAP's camera models: their numbers in files, and the lens that they are.

Pixel centers lie at +0.5. Of models that no lens here has, the count of numbers is known, so that a file can be read up
to an error that names the model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.problems import fault
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, Lens, Rational


@dataclass(frozen=True)
class CameraModel:
    """One of COLMAP's models."""

    name: str
    lens: type[Lens] | None
    """None: not read."""
    numbers: tuple[str, ...]
    """In the order of the files; f stands for fx and fy."""


_ONE, _TWO = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
_FISHEYE = ("k1", "k2", "k3", "k4")
_BROWN = ("k1", "k2", "p1", "p2")
MODELS = (
    CameraModel("SIMPLE_PINHOLE", BrownConrady, _ONE),
    CameraModel("PINHOLE", BrownConrady, _TWO),
    CameraModel("SIMPLE_RADIAL", BrownConrady, (*_ONE, "k1")),
    CameraModel("RADIAL", BrownConrady, (*_ONE, "k1", "k2")),
    CameraModel("OPENCV", BrownConrady, (*_TWO, *_BROWN)),
    CameraModel("OPENCV_FISHEYE", Fisheye, (*_TWO, *_FISHEYE)),
    CameraModel("FULL_OPENCV", Rational, (*_TWO, *_BROWN, "k3", "k4", "k5", "k6")),
    CameraModel("FOV", None, (*_TWO, "omega")),
    CameraModel("SIMPLE_RADIAL_FISHEYE", Fisheye, (*_ONE, "k1")),
    CameraModel("RADIAL_FISHEYE", Fisheye, (*_ONE, "k1", "k2")),
    CameraModel("THIN_PRISM_FISHEYE", None, (*_TWO, *_BROWN, "k3", "k4", "sx1", "sy1")),
)
"""By their numbers in binary files."""


def lens_of(model: CameraModel, values: Sequence[float], path: Path, camera: int) -> Lens:
    """Raises LogError for a model that is not read, and numbers that are no lens."""
    if model.lens is None:
        message = f"camera {camera} is a {model.name}, a lens that is not read"
        raise fault(path, message, "run COLMAP's image_undistorter, and read its images and model")
    numbers = dict(zip(model.numbers, map(float, values), strict=True))
    if "f" in numbers:
        focal = numbers.pop("f")
        numbers |= {"fx": focal, "fy": focal}
    try:
        return model.lens(**numbers)
    except ValueError as error:
        raise fault(
            path, f"camera {camera}: {error}", "run the reconstruction again, or leave the camera out"
        ) from error
