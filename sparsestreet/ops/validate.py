"""What the op demands of its inputs, in one place; every message names the invariant, the value and the remedy."""

import math

import torch
from torch import Tensor

from sparsestreet.types import Camera, Gaussians

LONGEST_SIDE = 1 << 22
"""Pixels: up to here all pixel centres, and the distances between them, are exact in float32."""
MOST_PIXELS = 1 << 29
"""Places in an image of three channels then fit 32 bits, in which the GPU's kernels count."""
_SHAPES = {"means": (3,), "quaternions": (4,), "scales": (3,), "opacities": (), "sh": (None, 3)}


def check_structure(gaussians: Gaussians, camera: Camera, background: Tensor | None) -> None:
    """Shapes, dtypes, devices and the camera; raises ValueError. Looks at no Gaussian's value, so it costs nothing."""
    means, rows = gaussians.means, gaussians.means.shape[0]
    for name, tail in _SHAPES.items():
        field = getattr(gaussians, name)
        expected = (rows, *tail)
        fits = field.dim() == len(expected) and all(
            want is None or got == want for got, want in zip(field.shape, expected, strict=True)
        )
        if not fits:
            text = f"[{', '.join('k' if want is None else str(want) for want in expected)}]"
            raise ValueError(f"{name} must have shape {text} like the {rows} rows of means, got {list(field.shape)}")
        if field.dtype != means.dtype or field.device != means.device:
            raise ValueError(
                f"all fields must share one dtype and device: means is {means.dtype} on {means.device}, {name} is "
                f"{field.dtype} on {field.device}; convert them with .to(means)"
            )
    if not means.dtype.is_floating_point:
        raise ValueError(f"means must be floating point, got {means.dtype}: convert the Gaussians to float32")
    if gaussians.sh.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"sh must hold 1, 4, 9 or 16 terms (degree 0 to 3), got {gaussians.sh.shape[1]}")
    _check_camera(camera)
    moved = gaussians.displacements
    if moved is not None and (moved.shape != means.shape or moved.dtype != means.dtype or moved.device != means.device):
        raise ValueError(
            f"displacements must be {list(means.shape)} {means.dtype} on {means.device} like the means, got "
            f"{list(moved.shape)} {moved.dtype} on {moved.device}: give one row of metres per Gaussian"
        )
    if background is not None:
        _check_background(background, camera, means)


def check_values(gaussians: Gaussians) -> None:
    """Every value finite, opacities in [0, 1], scales >= 0; raises ValueError naming field, row and value."""
    for name in (*_SHAPES, *(() if gaussians.displacements is None else ("displacements",))):
        field = getattr(gaussians, name).detach()
        _raise_at(name, field, torch.isfinite(field), "must be finite", "find the step that made it")
    opacities, scales = gaussians.opacities.detach(), gaussians.scales.detach()
    _raise_at("opacities", opacities, (opacities >= 0) & (opacities <= 1), "must lie in [0, 1]", "apply the sigmoid")
    _raise_at("scales", scales, scales >= 0, "must be >= 0 metres", "apply the exponential")


def _raise_at(name: str, field: Tensor, holds: Tensor, invariant: str, remedy: str) -> None:
    if bool(holds.all()):
        return
    index = (~holds).nonzero()[0].tolist()
    raise ValueError(f"{name} {invariant}, but row {index[0]} has {field[tuple(index)].item()}: {remedy}")


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
    if width * height > MOST_PIXELS:
        raise ValueError(
            f"the image may have at most {MOST_PIXELS} pixels, got {width}x{height}: render it in parts, each with its "
            "own principal point"
        )


def _check_camera(camera: Camera) -> None:
    _check_size(camera)
    for name, shape in (("camera_from_world", (4, 4)), ("intrinsics", (3, 3))):
        matrix = getattr(camera, name)
        if tuple(matrix.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, got {list(matrix.shape)}")
        if not all(math.isfinite(value) for row in matrix.tolist() for value in row):
            raise ValueError(f"{name} must be finite, got {matrix.tolist()}: check the pose at its source")
    (fx, skew, _), (lower, fy, _), last = camera.intrinsics.tolist()
    if not (fx > 0 and fy > 0 and skew == 0 and lower == 0 and last == [0, 0, 1]):
        raise ValueError(
            f"intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive focal lengths, got "
            f"{camera.intrinsics.tolist()}: remove skew by resampling the image"
        )
    _check_effects(camera)


def _check_effects(camera: Camera) -> None:
    parts = {"distortion": (camera.distortion, (5,))}
    if camera.shutter is not None:
        parts["shutter.translation"] = (camera.shutter.translation, (3,))
        parts["shutter.rotation"] = (camera.shutter.rotation, (3,))
    for name, (values, shape) in parts.items():
        if values is None:
            continue
        if tuple(values.shape) != shape or not all(math.isfinite(value) for value in values.tolist()):
            raise ValueError(f"camera.{name} must be {shape[0]} finite numbers, got {values.tolist()}")


def _check_background(background: Tensor, camera: Camera, means: Tensor) -> None:
    allowed = ((3,), (camera.height, camera.width, 3))
    if tuple(background.shape) not in allowed:
        raise ValueError(f"background must have shape [3] or {list(allowed[1])}, got {list(background.shape)}")
    if background.dtype != means.dtype or background.device != means.device:
        raise ValueError(
            f"background must be {means.dtype} on {means.device} like the means, got {background.dtype} on "
            f"{background.device}: convert it with .to(means)"
        )
