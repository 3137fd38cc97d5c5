"""The two cameras that look to the sides: fisheyes of 180 degrees, by Mei's model."""

from dataclasses import dataclass
from pathlib import Path

from sparsestreet.data.kitti.text import keyed_numbers, read_keyed
from sparsestreet.data.problems import fault
from sparsestreet.data.rig import check_lens_camera
from sparsestreet.geometry.lenses import Mei

_REMEDY = "copy it again from the published archive"
_SHAPE = ("xi", "k1", "k2", "p1", "p2", "gamma1", "gamma2")


@dataclass(frozen=True)
class FisheyeCamera:
    lens: Mei
    """Pixel centers at +0.5; the file counts from the center of the first pixel."""
    size: tuple[int, int]
    """(width, height)."""


def read_fisheye(path: Path) -> FisheyeCamera:
    """From OpenCV's YAML, whose names are unique and which has no space behind its colons; raises LogError."""
    table = read_keyed(path)
    kind = table.get("model_type", "MEI").strip("\"'")
    if kind.upper() != "MEI":
        raise fault(path, f"model_type is {kind!r}, the lens that is read is MEI", _REMEDY)
    names = (*_SHAPE, "u0", "v0", "image_width", "image_height")
    values = {name: float(keyed_numbers(table, name, (1,), path)[0]) for name in names}
    width, height = values["image_width"], values["image_height"]
    if not (1 <= width <= 16384 and 1 <= height <= 16384 and width % 1 == 0 and height % 1 == 0):
        raise fault(path, f"the image is {width:g} x {height:g}, no size of an image", _REMEDY)
    try:
        lens = Mei(u0=values["u0"] + 0.5, v0=values["v0"] + 0.5, **{name: values[name] for name in _SHAPE})
    except ValueError as error:
        raise fault(path, str(error), _REMEDY) from error
    size = int(width), int(height)
    check_lens_camera(path, lens, size)
    return FisheyeCamera(lens, size)
