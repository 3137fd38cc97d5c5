"""A camera and the settings as the table of numbers that the row kernels read, and the grid of tiles."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from sparsestreet.geometry.cameras import exact_position, numbers_of
from sparsestreet.geometry.lenses import fold_radius_squared
from sparsestreet.ops.settings import SplatSettings
from sparsestreet.ops.triton.launch import constant, jit, stream_of
from sparsestreet.ops.triton.quaternions import times
from sparsestreet.types import Camera

LENGTH = 12
RECORD = constant(LENGTH)
X, Y, L11, L21, L22, LOG2_OPACITY = (constant(i) for i in range(6))
# The exponent of 2 below which the splat is not drawn; then the color's three numbers and the depth.
CUTOFF, COLOR = constant(6), constant(7)
DEPTH_PLACE = 10
DEPTH = constant(DEPTH_PLACE)
# Written where rows have gates; of those without, nothing reads it.
GATE_PLACE = 11
GATE = constant(GATE_PLACE)


@jit
def record_of(records, row):
    """Pointer to the record of a row."""
    return records + row.to(tl.int64) * RECORD


# Halvings of the widest tile, of 64 columns.
LEVELS = constant(6)


@jit
def load_columns(table, row, mask, COUNT: tl.constexpr):
    """COUNT numbers of each lane's row; 0 where the mask is off."""
    width: tl.constexpr = 16 if COUNT % 16 == 0 else triton.next_power_of_2(COUNT)
    tiles = ()
    # All loads start before the first is waited for.
    for first in tl.static_range(0, COUNT, width):
        column = (first + tl.arange(0, width))[None, :]
        tiles += (tl.load(table + row[:, None] * COUNT + column, mask[:, None] & (column < COUNT), 0.0),)
    columns = ()
    for i in tl.static_range(len(tiles)):
        columns += unzipped(tiles[i], width)
    return columns


@jit
def places_of(first, rest, row, COLUMN: tl.constexpr, STORED: tl.constexpr):
    """Where 16 numbers of each row's harmonics lie, from COLUMN on; STORED: the coefficients behind the first."""
    column = (COLUMN + tl.arange(0, 16))[None, :]
    place = rest + row[:, None] * (3 * STORED) + (column - 3)
    # Elsewhere a choice of addresses would only take registers.
    if COLUMN == 0:
        place = tl.where(column < 3, first + row[:, None] * 3 + column, place)
    return place, column


@jit
def load_harmonics(first, rest, row, mask, TERMS: tl.constexpr, STORED: tl.constexpr):
    """The first TERMS coefficients of each lane's row, of two tables; 0 where the mask is off."""
    tiles, columns = (), ()
    for start in tl.static_range(0, 3 * TERMS, 16):
        place, column = places_of(first, rest, row, start, STORED)
        tiles += (tl.load(place, mask[:, None] & (column < 3 * TERMS), 0.0),)
    for i in tl.static_range(len(tiles)):
        columns += unzipped(tiles[i], 16)
    return columns


@jit
def store_harmonics(first, rest, row, values, mask, TERMS: tl.constexpr, STORED: tl.constexpr, REST: tl.constexpr):
    """The inverse; 0 behind the first TERMS. REST: whether more than the first coefficient is written."""
    count: tl.constexpr = 3 + 3 * STORED if REST else 3
    for start in tl.static_range(0, count, 16):
        columns = ()
        for i in tl.static_range(start, start + 16):
            columns += (values[i] if i < 3 * TERMS else tl.zeros_like(values[0]),)
        place, column = places_of(first, rest, row, start, STORED)
        tl.store(place, zipped(columns, 16), mask[:, None] & (column < count))


@jit
def store_columns(table, row, values, mask, COUNT: tl.constexpr):
    width: tl.constexpr = 16 if COUNT % 16 == 0 else triton.next_power_of_2(COUNT)
    for first in tl.static_range(0, COUNT, width):
        columns = ()
        for i in tl.static_range(first, first + width):
            columns += (values[i] if i < COUNT else values[0],)
        column = (first + tl.arange(0, width))[None, :]
        at = table + row[:, None] * COUNT + column
        tl.store(at, zipped(columns, width), mask[:, None] & (column < COUNT))


@jit
def unzipped(tile, WIDTH: tl.constexpr):
    """The columns of a tile [rows, WIDTH]."""
    parts = (tile,)
    # Each level has twice the parts of half the width.
    for level in tl.static_range(LEVELS):
        if WIDTH >> level > 1:
            halves = ()
            for i in tl.static_range(1 << level):
                half = tl.reshape(parts[i], (tile.shape[0], 2, WIDTH >> (level + 1)))
                left, right = tl.split(tl.permute(half, (0, 2, 1)))
                halves += (left, right)
            parts = halves
    columns = ()
    for i in tl.static_range(WIDTH):
        columns += (tl.reshape(parts[i], (tile.shape[0],)),)
    return columns


@jit
def zipped(columns, WIDTH: tl.constexpr):
    """The tile [rows, WIDTH] of these columns."""
    parts = ()
    for i in tl.static_range(WIDTH):
        parts += (tl.reshape(columns[i], (columns[i].shape[0], 1)),)
    for level in tl.static_range(LEVELS):
        if WIDTH >> level > 1:
            pairs = ()
            for i in tl.static_range(WIDTH >> (level + 1)):
                both = tl.permute(tl.join(parts[2 * i], parts[2 * i + 1]), (0, 2, 1))
                pairs += (tl.reshape(both, (columns[0].shape[0], 2 << level)),)
            parts = pairs
    return parts[0]


TILE_SIZE = 16
TILE = constant(TILE_SIZE)
MIN_LIGHT = 1e-30
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
            if len(_VIEWS) >= _MAX_VIEWS:
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
        return max(self.settings.transmittance_min, MIN_LIGHT)

    def table(self, device: torch.device) -> Float[Tensor, " numbers"]:
        """The numbers on the device, rounded from float64: one small copy when a stream first asks."""
        place = device, stream_of(device)
        table = self._tables.get(place)
        if table is None:
            table = torch.tensor(self._numbers, dtype=torch.float32).to(device, non_blocking=True)
            self._tables[place] = table
        return table


_MAX_VIEWS = 1 << 12  # the cameras of a log; half a kilobyte of the device each
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


# Of ops/reference: rounding must never cull a touched pixel.
BOX_MARGIN = constant(0.01)
# The pixel loop's rounding grows with the distances it squares.
RELATIVE_MARGIN = constant(1e-5)


@jit
def limited(value, least, most):
    return tl.minimum(tl.maximum(value, least), most)


@jit
def tile_span(low, high, size):
    """First and last tile with a pixel center in [low, high]; last < first if there is none. ``size`` in pixels."""
    # Limited as floats, because the box of a giant does not fit an integer.
    first = limited(tl.ceil(low - 0.5), 0.0, size).to(tl.int32)
    last = limited(tl.floor(high - 0.5), -1.0, size - 1.0).to(tl.int32)
    return first // TILE, tl.where(first <= last, last // TILE, first // TILE - 1)


@jit
def tile_rows(y, l22, reach, height, BOUNDED: tl.constexpr):
    """First and last row of tiles a splat reaches; ``reach`` is log2 opacity - cutoff, L in the record's units."""
    low = tl.zeros_like(y)
    high = low + height
    if BOUNDED:
        half = tl.sqrt(reach) / l22
        half += BOX_MARGIN + RELATIVE_MARGIN * half
        low, high = y - half, y + half
    return tile_span(low, high, height)


@jit
def half_chord(dy, half_width, half_y):
    """Half the width of the ellipse at height dy."""
    ratio = tl.where(half_y > 0, dy / half_y, 0.0)
    return half_width * tl.sqrt(tl.maximum(1 - ratio * ratio, 0.0))


@jit
def lines_span(x, y, l11, l21, l22, reach, line, LINES: tl.constexpr):
    """Least and largest x of the ellipse x(dy) = slope dy -+ half_chord(dy) within LINES lines of pixels from ``line``.

    Also whether the ellipse reaches them. Margins are included."""
    root = tl.sqrt(reach)
    slope, half_width, half_y = -l21 / l11, root / l11, root / l22
    half_x = root * tl.sqrt(l21 * l21 + l22 * l22) / (l11 * l22)
    # The right-most point lies at dy = peak, the left-most at -peak.
    peak = tl.where(half_x > 0, slope * half_y * half_y / half_x, 0.0)
    margin_x, margin_y = BOX_MARGIN + RELATIVE_MARGIN * half_x, BOX_MARGIN + RELATIVE_MARGIN * half_y
    top = line.to(tl.float32) + 0.5 - y
    first, last = top - margin_y, top + (LINES - 1.0) + margin_y
    low, high = limited(first, -half_y, half_y), limited(last, -half_y, half_y)
    at_right, at_left = limited(peak, low, high), limited(-peak, low, high)
    low_x = x + (slope * at_left - half_chord(at_left, half_width, half_y) - margin_x)
    high_x = x + (slope * at_right + half_chord(at_right, half_width, half_y) + margin_x)
    return low_x, high_x, (first <= half_y) & (last >= -half_y)


@jit
def tile_columns(x, y, l11, l21, l22, reach, row, width, BOUNDED: tl.constexpr):
    """First and last tile of row ``row`` that the ellipse passes through."""
    low_x = tl.zeros_like(x)
    high_x = low_x + width
    if BOUNDED:
        low_x, high_x, _ = lines_span(x, y, l11, l21, l22, reach, row * TILE, TILE)
    return tile_span(low_x, high_x, width)


@jit
def count_tiles(x, y, l11, l21, l22, reach, seen, width, height, BOUNDED: tl.constexpr):
    """Number of tiles of each lane's splat; 0 where not ``seen``."""
    first, last = tile_rows(y, l22, reach, height, BOUNDED)
    rows = tl.where(seen, last - first + 1, 0)
    count = 0 * first
    for i in range(tl.max(rows, 0)):
        left, right = tile_columns(x, y, l11, l21, l22, reach, first + i, width, BOUNDED)
        count += tl.where(i < rows, right - left + 1, 0)
    return count
