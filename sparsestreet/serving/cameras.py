"""Cameras of requests: a lens by its calibration, and the poses at both ends of the readout."""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from sparsestreet.geometry.cameras import inverse, resized
from sparsestreet.geometry.lenses import largest_shift
from sparsestreet.scene.edits.paths import between
from sparsestreet.serving import wire
from sparsestreet.serving.rig import Pose
from sparsestreet.types import Camera, Shutter, Side

_LOOKS = 0.05
"""Seconds after which somebody who waits looks whether the turn is still wanted."""


class Turns:
    """Gives turns in the order of asking; a lock would give them to whoever comes by."""

    def __init__(self) -> None:
        self._queue: deque[threading.Event] = deque()
        self._changing = threading.Lock()

    @contextmanager
    def turn(self, check_wanted: Callable[[], None]) -> Iterator[None]:
        """Waits, then nobody else has a turn until the block ends. ``check_wanted`` raises what ends the waiting."""
        mine = threading.Event()
        with self._changing:
            self._queue.append(mine)
            self._queue[0].set()
        try:
            while not mine.wait(_LOOKS):
                check_wanted()
            check_wanted()
            yield
        finally:
            with self._changing:
                self._queue.remove(mine)
                if self._queue:
                    self._queue[0].set()


MAX_SIDE, MAX_PIXELS = 8192, 36_000_000
"""Of an image: 36 million pixels take about 1 GB while they are rendered."""
FARTHEST = 1e6
"""Meters from the origin of the world, which lies in the street."""
_FOCAL_LENGTHS = (0.02, 500.0)
"""In widths of the image: 175 and 0.1 degrees."""
_UNIT = 0.01
"""How far the length of a quaternion may be from 1: those of messages are float32."""

READ_FIRST: dict[str, Side] = {
    "ROLLING_TOP_TO_BOTTOM": "top",
    "ROLLING_BOTTOM_TO_TOP": "bottom",
    "ROLLING_LEFT_TO_RIGHT": "left",
    "ROLLING_RIGHT_TO_LEFT": "right",
}


class NotServedError(ValueError):
    """A request for something that other renderers may have and this one has not."""


def matrix(pose: Any, what: str) -> Pose:
    """A message's pose as a matrix. Raises ValueError for one that is missing, not finite or no rotation."""
    vec, quat = pose.vec, pose.quat
    numbers = np.array([vec.x, vec.y, vec.z, quat.w, quat.x, quat.y, quat.z], np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{what} must be finite, got {numbers.tolist()}")
    if abs(np.linalg.norm(numbers[3:]) - 1) > _UNIT:
        raise ValueError(f"{what} has the quaternion (w, x, y, z) {numbers[3:].tolist()}: send one of length 1")
    if np.abs(numbers[:3]).max() > FARTHEST:
        raise ValueError(
            f"{what} lies {np.abs(numbers[:3]).max():.3g} m from the origin: send poses in the scene's world"
        )
    made = np.eye(4)
    made[:3, :3] = Rotation.from_quat(numbers[[4, 5, 6, 3]]).as_matrix()
    made[:3, 3] = numbers[:3]
    return made


def pose_message(pose: Pose) -> Any:
    """A matrix as a message's pose."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    vec = wire.kind("common.Vec3")(x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
    return wire.kind("common.Pose")(vec=vec, quat=wire.kind("common.Quat")(w=w, x=x, y=y, z=z))


def lens_of(spec: Any, height: int, width: int) -> Camera:
    """The camera of a message at the origin, with the pixels that are wanted instead of those of its calibration.

    Raises NotServedError for lenses that the splat op does not simulate, ValueError for numbers that cannot be.
    """
    name = spec.logical_id or "without a name"
    lens = spec.WhichOneof("camera_param")
    if lens is None:
        raise ValueError(f"camera {name} has no lens: send opencv_pinhole_param")
    if lens != "opencv_pinhole_param":
        raise NotServedError(
            f"camera {name} has the lens {lens.removesuffix('_param')}, this server has pinholes with Brown-Conrady "
            "distortion: send opencv_pinhole_param"
        )
    if spec.WhichOneof("external_distortion") is not None:
        raise NotServedError(f"camera {name} looks through a windshield, which is not simulated: leave it out")
    sizes = spec.resolution_w or width, spec.resolution_h or height
    for side in (*sizes, width, height):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"images of camera {name} have 1 to {MAX_SIDE} pixels a side, got {side}")
    if width * height > MAX_PIXELS:
        raise ValueError(f"images of camera {name} have at most {MAX_PIXELS:,} pixels, got {width} x {height}")
    intrinsics = _intrinsics(spec.opencv_pinhole_param, name, sizes)
    distortion = _distortion(spec.opencv_pinhole_param, name)
    if distortion is not None:
        _check_invertible(tuple(intrinsics.flatten().tolist()), tuple(distortion.tolist()), sizes)
    camera = Camera(torch.eye(4), intrinsics, *sizes, distortion)
    return camera if sizes == (width, height) else resized(camera, height, width)


def posed(camera: Camera, start: Pose, end: Pose, shutter: str, seconds: float, span: float) -> Camera:
    """A camera on its way from ``start`` to ``end``, world_from_camera while the first and the last row are read.

    Args:
        camera: its lens and its image.
        start: when readout begins; a global shutter has this pose alone.
        end: when it ends.
        shutter: the name of a ``ShutterType``.
        seconds: how long the readout takes.
        span: the same in the log's normalized time.

    Raises ValueError for a moving camera that does not say how it is read out.
    """
    if shutter in ("GLOBAL", "UNKNOWN"):
        if shutter == "UNKNOWN" and not np.allclose(start, end, atol=1e-5):
            raise ValueError("a camera that moves says how it is read out: send shutter_type, GLOBAL or ROLLING_...")
        return _at(camera, start, None)
    if shutter not in READ_FIRST:
        raise ValueError(f"shutter_type must be one of {', '.join(READ_FIRST)} and GLOBAL, got {shutter}")
    still = np.array_equal(start, end)
    if still and span == 0:
        return _at(camera, start, None)
    middle = start if still else between(start, end, 0.5)
    side = READ_FIRST[shutter]
    # The readout of the op begins and ends at the borders of the image, half a row beyond the centers of the rows
    # that the two poses belong to.
    lines = camera.width if side in ("left", "right") else camera.height
    stretch = lines / (lines - 1) if lines > 1 else 1.0
    translation = stretch * (middle[:3, :3].T @ (end - start)[:3, 3])
    rotation = stretch * Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    moved, turned = (torch.from_numpy(vector).float() for vector in (translation, rotation))
    return _at(camera, middle, Shutter(moved, turned, side, stretch * seconds, stretch * span))


def camera_spec(name: str, camera: Camera) -> Any:
    """A recorded camera as a message; poses are not part of it."""
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.double().tolist()
    spec = wire.kind("CameraSpec")(logical_id=name, resolution_h=camera.height, resolution_w=camera.width)
    pinhole = spec.opencv_pinhole_param
    pinhole.focal_length_x, pinhole.focal_length_y = fx, fy
    pinhole.principal_point_x, pinhole.principal_point_y = cx, cy
    k1, k2, p1, p2, k3 = [0.0] * 5 if camera.distortion is None else camera.distortion.double().tolist()
    pinhole.radial_coeffs.extend([k1, k2, k3, 0.0, 0.0, 0.0])
    pinhole.tangential_coeffs.extend([p1, p2])
    pinhole.thin_prism_coeffs.extend([0.0] * 4)
    words = {side: word for word, side in READ_FIRST.items()}
    shutter = "GLOBAL" if camera.shutter is None else words[camera.shutter.direction]
    spec.shutter_type = wire.number("ShutterType", shutter)
    return spec


def _at(camera: Camera, world_from_camera: Pose, shutter: Shutter | None) -> Camera:
    pose = inverse(torch.from_numpy(world_from_camera)).float()
    return Camera(pose, camera.intrinsics, camera.width, camera.height, camera.distortion, shutter)


def _intrinsics(param: Any, name: str, size: tuple[int, int]) -> torch.Tensor:
    numbers = (param.focal_length_x, param.focal_length_y, param.principal_point_x, param.principal_point_y)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"focal lengths and principal point of camera {name} must be finite, got {numbers}")
    least, most = (factor * size[0] for factor in _FOCAL_LENGTHS)
    if not all(least <= focal <= most for focal in numbers[:2]):
        raise ValueError(
            f"focal lengths of camera {name} lie within {least:g} and {most:g} pixels for its {size[0]} columns, got "
            f"{numbers[0]:g} and {numbers[1]:g}"
        )
    if any(abs(center) > 10 * side for center, side in zip(numbers[2:], size, strict=True)):
        raise ValueError(
            f"the principal point of camera {name} lies near its image, got {numbers[2]:g}, {numbers[3]:g}"
        )
    fx, fy, cx, cy = numbers
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _distortion(param: Any, name: str) -> torch.Tensor | None:
    given = {"radial_coeffs": 6, "tangential_coeffs": 2, "thin_prism_coeffs": 4}
    values = {key: list(getattr(param, key)) for key in given}
    for key, count in given.items():
        if len(values[key]) > count or not all(map(math.isfinite, values[key])):
            raise ValueError(f"{key} of camera {name} are at most {count} finite numbers, got {values[key][:8]}")
        values[key] += [0.0] * (count - len(values[key]))
    k1, k2, k3, *rational = values["radial_coeffs"]
    if any(rational) or any(values["thin_prism_coeffs"]):
        raise NotServedError(
            f"camera {name} has k4 to k6 or a thin prism, which are not simulated: fit k1, k2, p1, p2, k3 alone"
        )
    distortion = torch.tensor([k1, k2, *values["tangential_coeffs"], k3])
    return distortion if distortion.any() else None


@lru_cache(maxsize=64)
def _check_invertible(intrinsics: tuple[float, ...], distortion: tuple[float, ...], size: tuple[int, int]) -> None:
    """Raise ValueError for a lens that images nothing in parts of its image."""
    largest_shift(torch.tensor(intrinsics).reshape(3, 3), torch.tensor(distortion), *size)
