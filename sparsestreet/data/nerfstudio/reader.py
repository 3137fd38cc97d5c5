"""From a folder with ``transforms.json`` to a recording."""

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from sparsestreet.data.images import image_size
from sparsestreet.data.json_tree import JsonValue, read_json
from sparsestreet.data.ply import read_ply
from sparsestreet.data.posed_images import PosedImage, PosedReader, PosedTable
from sparsestreet.data.problems import LogError, attempt, missing_notes
from sparsestreet.data.reader import FolderSignature
from sparsestreet.geometry.lenses import BrownConrady, Fisheye, Lens

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
_OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular", "orthographic")
_NUMBERS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_READ = (
    "frames", "file_path", "transform_matrix", "mask_path", "time", "depth_file_path", "ply_file_path", "w", "h", "cx",
    "cy", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "camera_model", "is_fisheye", *_NUMBERS,
)  # fmt: skip
_HARMLESS = (
    "applied_transform", "applied_scale", "aabb", "aabb_scale", "scale", "offset", "orientation_override", "sharpness",
    "colmap_im_id", "rotation", "comment",
)  # fmt: skip
"""What was done before the file was written, or how another program sets up its own volume."""
_MAX_IMAGE = 100_000
"""Pixels on a side."""


def read_transforms(path: Path, *, skip: bool = False) -> PosedTable:
    """Raise LogError with every frame at fault. ``skip``: frames without the file of their image are left out."""
    top = read_json(path)
    listed = top["frames"].items()
    if not listed:
        raise top["frames"].fault("is empty", "write at least one frame")
    frames = [frame for frame in listed if _file(frame).is_file()] if skip else listed
    if not frames:
        message = f"has {len(listed)} frames, and the image of none is there, the first is {_file(listed[0])}"
        raise top["frames"].fault(message, "write the images")
    problems = []
    images = [attempt(problems, lambda frame=frame: _image(top, frame)) for frame in frames]
    if problems:
        raise LogError(problems)
    found = [image for image in images if image is not None]
    timed = sum(image.time is not None for image in found)
    if 0 < timed < len(found):
        raise top["frames"].fault(
            f"has a time in {timed} of {len(found)} frames", "write it for all of them, or for none"
        )
    points = top.get("ply_file_path")
    notes = missing_notes(len(listed) - len(frames), len(listed))
    if unread := dict.fromkeys(key for value in (top, *frames) for key in value.unread(_READ + _HARMLESS)):
        notes.append(f"nothing reads {', '.join(unread)} of transforms.json")
    if timed:
        notes.append("times of the frames order them, but their unit is not known: they are no clock")
    if any("depth_file_path" in frame for frame in frames):
        notes.append("depth images of the frames are not read")
    return PosedTable(path, found, None if points is None else points.path(), notes)


def _file(frame: JsonValue) -> Path:
    path = frame["file_path"].path()
    if not path.suffix and not path.is_file():
        path = path.with_name(path.name + ".png")  # Blender's files leave it out
    return path


def _image(top: JsonValue, frame: JsonValue) -> PosedImage:
    path = _file(frame)
    lens, size = _lens(top, frame, path)
    mask, time = frame.get("mask_path"), frame.get("time")
    return PosedImage(
        path,
        PurePosixPath(path.relative_to(top.file.parent).as_posix()),
        lens,
        size,
        _world_from_camera(frame["transform_matrix"]),
        None if mask is None else mask.path(),
        None if time is None else time.moment(),
    )


def _world_from_camera(value: JsonValue) -> Float64[Tensor, "4 4"]:
    """From OpenGL's axes to OpenCV's."""
    rows = len(value.items())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:rows] = value.matrix(rows if rows in (3, 4) else 4, 4)
    return pose @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def _lens(top: JsonValue, frame: JsonValue, image: Path) -> tuple[Lens, tuple[int, int]]:
    def value(key: str) -> JsonValue | None:
        return frame.get(key) or top.get(key)

    def number(key: str, otherwise: float = 0.0) -> float:
        found = value(key)
        return otherwise if found is None else found.number()

    size = _size(value("w"), value("h"), image)
    fx = _focal(top, frame, "fl_x", "camera_angle_x", size[0], None)
    fy = _focal(top, frame, "fl_y", "camera_angle_y", size[1], fx)
    focal = {"fx": fx, "fy": fy, "cx": number("cx", size[0] / 2), "cy": number("cy", size[1] / 2)}
    _refuse_other_lenses(top, frame)
    fisheye = _is_fisheye(value("camera_model"), value("is_fisheye"))
    known = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    for key in _NUMBERS:
        if key not in known and number(key):
            remedy = f"write 0, or a camera_model that has it ({'OPENCV' if fisheye else 'OPENCV_FISHEYE'})"
            raise (value(key) or frame).fault(f"is not 0, but this model has no {key}", remedy)
    numbers = {key: number(key) for key in known}
    return (Fisheye if fisheye else BrownConrady)(**focal, **numbers), size


def _refuse_other_lenses(*values: JsonValue) -> None:
    """Instant-ngp names a lens by the keys that are there."""
    for value in values:
        for key in _OTHER_LENSES:
            if key in value and value[key].value is not False:
                raise value.fault(f"has {key!r}, a lens that is not read", "undistort the images first")


def _is_fisheye(model: JsonValue | None, flag: JsonValue | None) -> bool:
    """By nerfstudio's name of the model, or by instant-ngp's flag. Raises LogError where they contradict each other."""
    if model is None:
        return flag is not None and flag.truth()
    name = model.text()
    if name not in _FISHEYE + _PERSPECTIVE:
        remedy = f"undistort the images first, or write one of {', '.join(_PERSPECTIVE + _FISHEYE)}"
        raise model.fault(f"is {name[:40]!r}, a lens that is not read", remedy)
    if flag is not None and flag.truth() != (name in _FISHEYE):
        raise flag.fault(f"is {flag.value}, but camera_model is {name}", "remove the one that is wrong")
    return name in _FISHEYE


def _size(width: JsonValue | None, height: JsonValue | None, image: Path) -> tuple[int, int]:
    if width is None or height is None:
        return image_size(image)
    return width.whole(1, _MAX_IMAGE), height.whole(1, _MAX_IMAGE)


def _focal(top: JsonValue, frame: JsonValue, key: str, angle: str, pixels: int, otherwise: float | None) -> float:
    """Pixels: as such, or from the field of view in radians."""
    focal = frame.get(key) or top.get(key)
    if focal is not None:
        return focal.number(positive=True)
    field = frame.get(angle) or top.get(angle)
    if field is None:
        if otherwise is not None:
            return otherwise
        raise frame.fault(f"has no {key!r}, nor has the top of the file", f"write {key} or {angle}")
    radians = field.number(positive=True)
    if radians >= math.pi:
        raise field.fault(f"is {radians:g} radians, a pinhole sees less than pi", "write radians")
    return pixels / 2 / math.tan(radians / 2)


@dataclass(frozen=True, kw_only=True)
class NerfstudioReader(PosedReader):
    """A folder with ``transforms.json``, as nerfstudio and instant-ngp write it.

    The world is that of the file's poses and points.
    """

    marks = FolderSignature(("transforms.json",))

    def table(self) -> PosedTable:
        return read_transforms(self.folder / "transforms.json", skip=self.missing == "skip")

    def read_points(self, path: Path) -> tuple[Float64[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        return read_ply(path)
