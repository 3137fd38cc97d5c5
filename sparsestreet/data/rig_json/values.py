"""Poses, lenses and stamps as ``rig.json`` has them."""

from dataclasses import MISSING, fields
from typing import get_args

import torch
from jaxtyping import Float64
from torch import Tensor

from sparsestreet.data.json_tree import JsonValue
from sparsestreet.data.poses import check_rigid
from sparsestreet.geometry import quaternions as quat
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, FTheta, Lens, Mei, Rational
from sparsestreet.types import Side

_LATEST = 2**62
_LONGEST_READOUT = 0.5
LENSES: dict[str, type[Lens]] = {
    "pinhole": BrownConrady,
    "opencv": BrownConrady,
    "rational": Rational,
    "fisheye": Fisheye,
    "mei": Mei,
    "f_theta": FTheta,
}
"""Their numbers have the names of the classes' fields."""
_CENTERS = ("cx", "cy", "u0", "v0")
_LISTS = {"polynomial": None, "linear": 3}
"""Numbers that are lists, and of how many; None: of any."""


def read_pose(value: JsonValue) -> Float64[Tensor, "4 4"]:
    """A 4x4 matrix, or a translation and a rotation: a quaternion wxyz. Raises LogError for what is not rigid."""
    if isinstance(value.value, list):
        pose = value.matrix(4, 4)
    else:
        value.only("translation", "rotation")
        rotation = torch.tensor(value["rotation"].numbers(4), dtype=torch.float64)
        if not 0.99 < float(rotation.norm()) < 1.01:
            message = f"is no unit quaternion, its length is {float(rotation.norm()):.3g}"
            raise value["rotation"].fault(message, "write w, x, y, z of a rotation")
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = quat.to_matrix(rotation / rotation.norm())
        pose[:3, 3] = torch.tensor(value["translation"].numbers(3), dtype=torch.float64)
    check_rigid(pose, value.file, value.where)
    return pose


def read_stamp(value: JsonValue) -> int:
    """Nanoseconds, whole: a decimal second would be rounded."""
    return value.whole(-_LATEST, _LATEST)


def read_shutter(value: JsonValue | None) -> tuple[int, Side]:
    """How long a readout takes, nanoseconds, and on which side it starts; None: all pixels are exposed at once."""
    if value is None:
        return 0, "top"
    seconds = value.only("readout", "first")["readout"].number(positive=True)
    if seconds > _LONGEST_READOUT:
        message = f"is {seconds:g} s, longer than any readout"
        raise value["readout"].fault(message, "write seconds from the first row or column to the last")
    side = value["first"]
    for known in get_args(Side):
        if side.text() == known:
            return round(1e9 * seconds), known
    raise side.fault(f"is {side.text()[:40]!r}, no side of an image", f"write one of {', '.join(get_args(Side))}")


def read_lens(value: JsonValue) -> Lens:
    """The model and its numbers. ``first_pixel`` is where the calibration has the center of the first pixel: 0.5, or 0
    as OpenCV's programs have it. Raises LogError for a model that is not known, and numbers that are no lens."""
    model = value["model"]
    if model.text() not in LENSES:
        raise model.fault(f"is {model.text()[:40]!r}, a lens that is not known", f"write one of {', '.join(LENSES)}")
    kind = LENSES[model.text()]
    # A pinhole has no other numbers.
    entries = [entry for entry in fields(kind) if model.value != "pinhole" or entry.default is MISSING]
    value.only("model", "first_pixel", *(entry.name for entry in entries))
    first = value.get("first_pixel")
    shift = 0.0 if first is None else 0.5 - first.number()
    if shift not in (0.0, 0.5):
        raise value["first_pixel"].fault("is where the first pixel's center lies, 0 or 0.5", "write one of them")
    numbers = {}
    for entry in entries:
        if entry.default is MISSING or entry.name in value:
            number = value[entry.name]
            if entry.name in _LISTS:
                numbers[entry.name] = number.numbers(_LISTS[entry.name])
            else:
                numbers[entry.name] = number.number() + (shift if entry.name in _CENTERS else 0.0)
    try:
        return kind(**numbers)
    except ValueError as error:
        raise value.fault(f"is no lens: {error}", "write the calibration again") from error
