"""A camera and the settings as the table of numbers that the row kernels read, and the grid of tiles."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.cameras import exact_position, numbers_of
from sparsestreet.geometry.lenses import fold_radius_squared
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import stream_of
from sparsestreet.ops.triton.vectors import times
from sparsestreet.types import Camera

TILE_SIZE = 16
TILE = constant(TILE_SIZE)
LEAST_LIGHT = 1e-30
"""As in ops/cpu: a pixel stops at this light at the latest."""

# Places in the table.
ROTATION, POSITION = constant(0), constant(9)
FOCAL, CENTER = constant(12), constant(14)
SLOPE_LEAST, SLOPE_MOST = constant(16), constant(18)
SIZE, BLUR, NEAR = constant(20), constant(22), constant(23)
ALPHA_MIN, LOG2_ALPHA_MIN, BOX_REACH = constant(24), constant(25), constant(26)
DISTORTION, FOLD = constant(27), constant(32)
SHIFT, TURN = constant(33), constant(36)
POSITION_REST = constant(39)
# Focal lengths, negative if the readout runs towards smaller coordinates.
MOTION_FOCAL = constant(42)


@jit
def load_vector(table):
    return tl.load(table), tl.load(table + 1), tl.load(table + 2)


@jit
def load_matrix(table):
    return load_vector(table), load_vector(table + 3), load_vector(table + 6)


@jit
def in_camera(view, rotation, mean):
    """A mean in the camera. The difference of near points far from the origin is exact; R m + t would round both."""
    c, rest = load_vector(view + POSITION), load_vector(view + POSITION_REST)
    return times(rotation, ((mean[0] - c[0]) - rest[0], (mean[1] - c[1]) - rest[1], (mean[2] - c[2]) - rest[2]))


@dataclass(frozen=True)
class KernelView:
    """One camera and the settings, with the switches that kernels are compiled for.

    ``KernelView.of`` gives the same one for equal numbers, with the table it already has on the device."""

    camera: Camera
    settings: SplatSettings
    _numbers: list[float] = field(init=False, repr=False, compare=False)
    _tables: dict[tuple[torch.device, int], Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # At once, because the camera's tensors may change.
        object.__setattr__(self, "_numbers", _numbers(self.camera, self.settings))

    @staticmethod
    def of(camera: Camera, settings: SplatSettings) -> "KernelView":
        """The view of the camera as it is now."""
        key = numbers_of(camera), settings
        view = _VIEWS.get(key)
        if view is None:
            if len(_VIEWS) >= _MOST_VIEWS:
                _VIEWS.clear()
            view = _VIEWS[key] = KernelView(camera, settings)
        return view

    @cached_property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of 16x16 tiles."""
        return -(-self.camera.width // TILE_SIZE), -(-self.camera.height // TILE_SIZE)

    @property
    def distorted(self) -> bool:
        return self.camera.distortion is not None

    @property
    def rolling(self) -> bool:
        return self.camera.shutter is not None

    @property
    def columns(self) -> bool:
        """Whether the shutter reads columns one after the other, instead of rows."""
        return self.camera.shutter is not None and self.camera.shutter.reads_columns

    @property
    def bounded(self) -> bool:
        """Whether splats have an end."""
        return self.settings.alpha_min > 0 or math.isfinite(self.settings.max_sigma)

    @property
    def exclusive(self) -> bool:
        return self.settings.stop == "exclusive"

    @cached_property
    def transmittance_min(self) -> float:
        """Never 0, because backward divides the light that is left, which must not vanish."""
        return max(self.settings.transmittance_min, LEAST_LIGHT)

    def table(self, device: torch.device) -> Float[Tensor, " numbers"]:
        """The numbers on the device, rounded from float64: one small copy when a stream first asks."""
        place = device, stream_of(device)
        table = self._tables.get(place)
        if table is None:
            table = torch.tensor(self._numbers, dtype=torch.float32).to(device, non_blocking=True)
            self._tables[place] = table
        return table


_MOST_VIEWS = 1 << 12  # the cameras of a log; half a kilobyte of the device each
_VIEWS: dict[tuple, KernelView] = {}


def _numbers(camera: Camera, s: SplatSettings) -> list[float]:
    """In the order of the places above."""
    pose, K = camera.camera_from_world.double().tolist(), camera.intrinsics.double().tolist()
    position = exact_position(camera)
    slopes = [_slope_limits(K[axis][axis], K[axis][2], size) for axis, size in enumerate((camera.width, camera.height))]
    distortion = [0.0] * 5 if camera.distortion is None else camera.distortion.double().tolist()
    motion, sign = [0.0] * 6, 0
    if camera.shutter is not None:
        motion = [*camera.shutter.translation.double().tolist(), *camera.shutter.rotation.double().tolist()]
        sign = camera.shutter.sign
    numbers = (
        *(value for row in pose[:3] for value in row[:3]),
        *position.tolist(),
        *(K[0][0], K[1][1], K[0][2], K[1][2]),
        *(slopes[0][0], slopes[1][0], slopes[0][1], slopes[1][1]),
        *(camera.width, camera.height, s.eps2d, s.near_plane),
        # Without a cut-off the exponent still ends where float32 does: 2^-126.
        *(s.alpha_min, math.log2(s.alpha_min) if s.alpha_min > 0 else -126.0, s.max_sigma * s.max_sigma),
        *distortion,
        math.inf if camera.distortion is None else fold_radius_squared(camera.distortion),
        *motion,
        # The rest of the position, which float32 cannot hold.
        *(position - position.float().double()).tolist(),
        *(sign * K[0][0], sign * K[1][1]),
    )
    return list(map(float, numbers))


def _slope_limits(focal: float, center: float, size: int) -> tuple[float, float]:
    """Limits of x/z in the Jacobian: 1.3 tan(fov/2) of 3DGS, moved with the principal point."""
    margin = 0.3 * size / (2 * focal)
    return -center / focal - margin, (size - center) / focal + margin
