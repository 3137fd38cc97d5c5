"""Checks of the op's inputs, in one place; every message names the invariant, the value and the remedy."""

import math
from collections.abc import Sequence
from typing import get_args

import torch
from jaxtyping import Bool
from torch import Tensor

from sparsestreet.finite import check_finite, check_rows
from sparsestreet.geometry.cameras import numbers_of
from sparsestreet.types import Camera, Gaussians, Harmonics, Side

LONGEST_SIDE = 1 << 22
"""Longest side of an image, pixels: up to here all pixel centers are exact in float32."""
MAX_PIXELS = 1 << 29
"""Most pixels of an image: the indices of its three channels then fit the 32-bit integers of the GPU's kernels."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of R R^T - I. Poses in text files keep four digits or more; a pose with scale or shear is further off.

An error of 1e-3 moves a point at the edge of an image by a pixel."""
MAX_DISTORTION = 1e12
"""Largest coefficient of a lens: no real one comes near, and its powers stay finite in float32."""
_GOOD: set[tuple[object, ...]] = set()
"""Numbers of cameras that were found good; a log has some thousands."""
_MOST_GOOD = 1 << 14
_SHAPES = {"means": (3,), "quaternions": (4,), "scales": (3,), "opacities": ()}
_TERMS = (1, 4, 9, 16)


def check_dtype(gaussians: Gaussians, who: str) -> None:
    """Raise ValueError, naming ``who`` computes, for dtypes other than float32 and float64."""
    if gaussians.means.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"{who} computes in float32 or float64, got {gaussians.means.dtype}: convert the Gaussians "
            "with dataclasses.replace and .float()"
        )


def check_structure(gaussians: Gaussians, camera: Camera, background: Tensor | None) -> None:
    """Check shapes, dtypes, devices, the camera and a background on the host; raise ValueError.

    It reads neither values of Gaussians nor anything on a GPU, so it is cheap and never waits.
    """
    means, rows = gaussians.means, gaussians.means.shape[0]
    for name, tail in _SHAPES.items():
        _check_field(name, getattr(gaussians, name), (rows, *tail), means)
    if isinstance(gaussians.sh, Harmonics):
        _check_tables(gaussians.sh, means)
    else:
        # They have any number of terms.
        _check_field("sh", gaussians.sh, (rows, gaussians.sh.shape[1] if gaussians.sh.dim() > 1 else None, 3), means)
    if not means.dtype.is_floating_point:
        raise ValueError(f"means must be floating point, got {means.dtype}: convert the Gaussians to float32")
    terms = gaussians.sh.terms if isinstance(gaussians.sh, Harmonics) else gaussians.sh.shape[1]
    if terms not in _TERMS:
        raise ValueError(f"sh must hold 1, 4, 9 or 16 terms (degree 0 to 3), got {terms}")
    check_camera(camera)
    if gaussians.displacements is not None:
        _check_like(means, "displacements", gaussians.displacements, means.shape, "give one row of meters per Gaussian")
    if background is not None:
        _check_background(background, camera, means)


def _check_field(name: str, field: Tensor, expected: tuple[int | None, ...], means: Tensor) -> None:
    if field.shape != expected:
        text = f"[{', '.join('k' if want is None else str(want) for want in expected)}]"
        raise ValueError(f"{name} must have shape {text} like the {len(means)} rows of means, got {list(field.shape)}")
    if field.dtype != means.dtype or field.device != means.device:
        raise ValueError(
            f"all fields must share one dtype and device: means is {means.dtype} on {means.device}, {name} is "
            f"{field.dtype} on {field.device}; convert them with .to(means)"
        )


def _check_tables(sh: Harmonics, means: Tensor) -> None:
    """Tables of harmonics in pairs, which together have the rows of the means."""
    counts = [len(first) for first in sh.first]
    if [len(rest) for rest in sh.rest] != counts or sum(counts) != len(means):
        raise ValueError(
            f"the tables of sh must have the {len(means)} rows of means together, and first and rest the same, got "
            f"{counts} and {[len(rest) for rest in sh.rest]}"
        )
    for first, rest in zip(sh.first, sh.rest, strict=True):
        stored = rest.shape[1] if rest.dim() > 1 else None
        if stored is not None and stored + 1 not in _TERMS:
            raise ValueError(f"sh.rest must store 0, 3, 8 or 15 coefficients (degree 0 to 3), got {stored}")
        _check_field("sh.first", first, (len(first), 1, 3), means)
        _check_field("sh.rest", rest, (len(rest), stored, 3), means)


def _check_like(means: Tensor, name: str, values: Tensor, shape: tuple[int, ...], remedy: str) -> None:
    if values.shape != shape or values.dtype != means.dtype or values.device != means.device:
        raise ValueError(
            f"{name} must be {list(shape)} {means.dtype} on {means.device} like the means, got {list(values.shape)} "
            f"{values.dtype} on {values.device}: {remedy}"
        )


def check_pixel_weights(weights: Tensor, camera: Camera, means: Tensor) -> None:
    """Check for one finite weight >= 0 per pixel, like the means; raise ValueError. Waits for a GPU."""
    shape = (camera.height, camera.width)
    _check_like(means, "pixel_weights", weights, shape, "give one weight per pixel of the camera")
    # NaN compares false.
    _raise_in_image("pixel_weights", weights, (weights >= 0) & (weights < math.inf), "must be finite and >= 0")


def check_changes(
    weights: Tensor, background: Tensor | None, gates: Tensor | None, camera: Camera, means: Tensor
) -> None:
    """Check the shapes of what backward gathers changes with, and that no gate hides a row; raise ValueError.

    Values are not checked, which would wait for a GPU."""
    if gates is not None:
        raise ValueError("changes are of all rows, but gates hide some of them: leave out gates or changes")
    shape = (camera.height, camera.width)
    _check_like(means, "pixel_weights", weights, (3, *shape), "give three weights per pixel of the camera")
    if background is not None:
        _check_like(means, "background", background, (*shape, 3), "give one color per pixel of the camera")


def check_gates(gates: Tensor, means: Tensor) -> None:
    """Check for one gate in [0, 1] per row, of the means' dtype and device; raise ValueError.

    As those of a background, values on a GPU are not checked, which would wait for it."""
    _check_like(means, "gates", gates, means.shape[:1], "give one factor per Gaussian")
    if gates.device.type == "cpu":
        values = gates.detach()
        inside = (values >= 0) & (values <= 1)
        check_rows("gates", values, inside, "must lie in [0, 1]", "sample or clamp them")


def check_values(gaussians: Gaussians, drawn: Bool[Tensor, " n"] | None = None) -> None:
    """Check that values are finite, opacities in [0, 1], scales >= 0; raise ValueError naming field, row and value.

    Rows of opacity 0 are not checked, because they are culled before anything else of them is read. ``drawn``: the rows
    whose harmonics are checked; None: those of all rows, for when a bad one is known to exist.
    """
    opacities, scales = gaussians.opacities.detach(), gaussians.scales.detach()
    masked = opacities == 0
    fields = gaussians.columns()
    if gaussians.displacements is not None:
        fields["displacements"] = gaussians.displacements
    for name, field in fields.items():
        unread = ~drawn if name == "sh" and drawn is not None else masked
        check_finite({name: field.detach()}, "check what computed it", unread=unread)
    inside = (opacities >= 0) & (opacities <= 1)
    check_rows("opacities", opacities, inside, "must lie in [0, 1]", "apply the sigmoid", unread=masked)
    check_rows("scales", scales, scales >= 0, "must be >= 0 meters", "apply the exponential", unread=masked)


def _raise_in_image(name: str, image: Tensor, holds: Tensor, invariant: str) -> None:
    if bool(holds.all()):
        return
    place = (~holds).nonzero()[0].tolist()
    value = image[tuple(place)].item()
    raise ValueError(f"{name} {invariant}, but at {place} it is {value}: check what computed it")


def _check_size(camera: Camera) -> None:
    width, height = camera.width, camera.height
    for name, side in (("width", width), ("height", height)):
        if not isinstance(side, int) or isinstance(side, bool):
            raise ValueError(f"{name} must be an int, got {side!r}: convert it with int()")
    if width < 1 or height < 1:
        raise ValueError(f"the image needs at least 1x1 pixels, got width {width} and height {height}")
    if max(width, height) > LONGEST_SIDE:
        raise ValueError(
            f"the image may be at most {LONGEST_SIDE} pixels wide and high, got {width}x{height}: render it in parts"
        )
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"the image may have at most {MAX_PIXELS} pixels, got {width}x{height}: render it in parts, each with its "
            "own principal point"
        )


def check_camera(camera: Camera) -> None:
    """Check a camera's size, pose, intrinsics and effects; raise ValueError.

    Numbers that were found good are not checked again. NaN equals nothing, so it never was."""
    _check_size(camera)
    for name, shape in (("camera_from_world", (4, 4)), ("intrinsics", (3, 3))):
        given = getattr(camera, name).shape
        if given != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, got {list(given)}")
    numbers = numbers_of(camera)
    if numbers in _GOOD:
        return
    _check_numbers(camera)
    if len(_GOOD) >= _MOST_GOOD:
        _GOOD.clear()
    _GOOD.add(numbers)


def _check_numbers(camera: Camera) -> None:
    for name in ("camera_from_world", "intrinsics"):
        matrix = getattr(camera, name)
        if not all(math.isfinite(value) for row in matrix.tolist() for value in row):
            raise ValueError(f"{name} must be finite, got {matrix.tolist()}: check the pose at its source")
    _check_pose(camera.camera_from_world.tolist())
    (fx, skew, _), (lower, fy, _), last = camera.intrinsics.tolist()
    if not (fx > 0 and fy > 0 and skew == 0 and lower == 0 and last == [0, 0, 1]):
        raise ValueError(
            f"intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, got "
            f"{camera.intrinsics.tolist()}: remove skew by resampling the image"
        )
    _check_effects(camera)


def _check_pose(pose: list[list[float]]) -> None:
    x, y, z = (row[:3] for row in pose[:3])
    axes = ((x, x, 1), (y, y, 1), (z, z, 1), (x, y, 0), (x, z, 0), (y, z, 0))
    error = max(abs(_dot(a, b) - expected) for a, b, expected in axes)
    cross = (y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0])
    determinant = _dot(x, cross)
    if error <= RIGID_TOLERANCE and determinant > 0 and pose[3] == [0, 0, 0, 1]:
        return
    raise ValueError(
        f"camera_from_world must be a rigid motion, R R^T = 1 within {RIGID_TOLERANCE}, det R > 0 and last row "
        f"[0, 0, 0, 1], but R R^T is off by {error:.4g}, det R = {determinant:.4g}, last row {pose[3]}: take scale, "
        "shear and mirroring out of the pose"
    )


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _check_effects(camera: Camera) -> None:
    if camera.distortion is not None:
        given = camera.distortion.tolist()
        if tuple(camera.distortion.shape) != (5,) or not all(abs(value) <= MAX_DISTORTION for value in given):
            raise ValueError(
                f"camera.distortion must be 5 numbers of at most {MAX_DISTORTION:g}, got {given}: check k1, k2, "
                "p1, p2, k3 against the calibration"
            )
    if camera.shutter is None:
        return
    for name in ("translation", "rotation"):
        values = getattr(camera.shutter, name)
        if tuple(values.shape) != (3,) or not all(math.isfinite(value) for value in values.tolist()):
            raise ValueError(f"camera.shutter.{name} must be 3 finite numbers, got {values.tolist()}")
    direction = camera.shutter.direction
    if direction not in get_args(Side):
        raise ValueError(
            f"camera.shutter.direction must be one of {', '.join(get_args(Side))}, got {direction!r}: name the side of "
            "the image that is read first"
        )


def _check_background(background: Tensor, camera: Camera, means: Tensor) -> None:
    allowed = ((3,), (camera.height, camera.width, 3))
    if tuple(background.shape) not in allowed:
        raise ValueError(f"background must have shape [3] or {list(allowed[1])}, got {list(background.shape)}")
    if background.dtype != means.dtype or background.device != means.device:
        raise ValueError(
            f"background must be {means.dtype} on {means.device} like the means, got {background.dtype} on "
            f"{background.device}: convert it with .to(means)"
        )
    # If a value is infinite or NaN, so is the sum, which takes a fortieth of the time. On a GPU it would wait once
    # more.
    values = background.detach()
    if values.device.type == "cpu" and not math.isfinite(values.sum()):
        _raise_in_image("background", values, torch.isfinite(values), "must be finite")
