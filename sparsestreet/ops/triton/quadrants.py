"""A tile's four quadrants of 8x8 pixels: top left, top right, bottom left, bottom right.

Most splats are smaller than a tile. So each pair says which quadrants of its tile the splat can touch, and pixel
kernels
skip the others. Each lane of a warp holds two pixels of each quadrant in one line, so that what depends only on y is
computed once.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.tiles import lines_span
from sparsestreet.ops.triton.view import TILE

SIDE = constant(8)
QUADRANT_PIXELS = 64
PIXELS = constant(QUADRANT_PIXELS)
WARP = constant(32)
QUADRANT_SHIFT = 28
MOST_ROWS = 1 << QUADRANT_SHIFT
"""Most rows: a pair stores its row and its quadrants in 32 bits."""
ROW = constant(MOST_ROWS - 1)
SHIFT = constant(QUADRANT_SHIFT)
ALL = constant(15)


@jit
def row_of(pair):
    """The row of a pair."""
    return pair & ROW


@jit
def touches(pair, QUADRANT: tl.constexpr):
    """Whether the pair's splat can touch a quadrant."""
    return ((pair >> (SHIFT + QUADRANT)) & 1) != 0


@jit
def half_spans(splat, reach, tile_y, BOUNDED: tl.constexpr):
    """Least and largest x of the ellipse (tiles.py) in the upper and lower half of a row of tiles.

    Also whether it reaches each half. Empty if nothing bounds the splat."""
    spans = ()
    if BOUNDED:
        x, y, l11, l21, l22 = splat
        for half in tl.static_range(2):
            spans += (lines_span(x, y, l11, l21, l22, reach, tile_y * TILE + half * SIDE, SIDE),)
    return spans


@jit
def touched_quadrants(spans, tile_x, BOUNDED: tl.constexpr):
    """Bits of the quadrants of a tile that hold a pixel center of the ellipse, as a pair carries them."""
    bits = tl.zeros_like(tile_x) + ALL
    if BOUNDED:
        bits = tl.zeros_like(tile_x)
        middle = (tile_x * TILE + SIDE).to(tl.float32)
        for half in tl.static_range(2):
            low, high, reached = spans[half]
            left = reached & (low <= middle - 0.5) & (high >= middle - (SIDE - 0.5))
            right = reached & (high >= middle + 0.5) & (low <= middle + (SIDE - 0.5))
            bits = bits | (left.to(tl.int32) << (2 * half)) | (right.to(tl.int32) << (2 * half + 1))
    return bits << SHIFT


@jit
def quadrant_pixels(tile, tiles_x, QUADRANT: tl.constexpr):
    """Columns and lines of a quadrant's pixels [64]. Each lane gets one of 32 neighbors, so its two are four apart."""
    p = tl.arange(0, PIXELS)
    x = (tile % tiles_x) * TILE + QUADRANT % 2 * SIDE + p // WARP * 4 + p % WARP // SIDE
    y = (tile // tiles_x) * TILE + QUADRANT // 2 * SIDE + p % SIDE
    return x, y


@jit
def quadrant_places(tile, width, height, tiles_x, QUADRANT: tl.constexpr):
    """Indices of a quadrant's pixels in the image, and which of them lie in it; [64]."""
    x, y = quadrant_pixels(tile, tiles_x, QUADRANT)
    return y * width + x, (x < width) & (y < height)


@jit
def part_places(part, QUADRANT: tl.constexpr):
    """Indices of a quadrant's pixels in the layers of parts [64], of all, because those outside the image are read."""
    x, y = quadrant_pixels(0, 1, QUADRANT)
    return part * TILE * TILE + y * TILE + x


@jit
def centers(tile, tiles_x):
    """Centers of the upper left quadrant's pixels. For other quadrants kernels move the splat by SIDE."""
    x, y = quadrant_pixels(tile, tiles_x, 0)
    return x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5


@jit
def lane_sum(values):
    """Sums over the two pixels of each lane [32]."""
    return tl.sum(tl.reshape(values, (PIXELS // WARP, WARP)), 0)


@jit
def of_lane(values):
    """Values that the two pixels of each lane share [32]."""
    return tl.max(tl.reshape(values, (PIXELS // WARP, WARP)), 0)


@jit
def load_shape(records, row, GATED: tl.constexpr):
    """Mean and factor of the row's splat; log2 of its opacity, the cutoff, and its gate where rows have gates."""
    s = record.record_of(records, row)
    geometry = (
        tl.load(s + record.X), tl.load(s + record.Y),
        tl.load(s + record.L11), tl.load(s + record.L21), tl.load(s + record.L22),
    )  # fmt: skip
    ends = (tl.load(s + record.LOG2_OPACITY), tl.load(s + record.CUTOFF))
    if GATED:
        ends += (tl.load(s + record.GATE),)
    return geometry, ends


@jit
def load_splat(records, row, GATED: tl.constexpr):
    """The shape of the row's splat (``load_shape``), its color and depth."""
    geometry, ends = load_shape(records, row, GATED)
    s = record.record_of(records, row)
    return geometry, ends, (
        tl.load(s + record.COLOR), tl.load(s + record.COLOR + 1), tl.load(s + record.COLOR + 2),
        tl.load(s + record.DEPTH),
    )  # fmt: skip


@jit
def hold_splats(records, pair_rows, k, end, GATED: tl.constexpr):
    """Of WARP pairs from ``k`` on one splat in each lane: the numbers of ``load_splat`` and whatever behind ``end``."""
    pair = k + tl.arange(0, WARP)
    given = pair < end
    s = record.record_of(records, row_of(tl.load(pair_rows + pair, given, 0)))
    held = (
        tl.load(s + record.X, given, 0.0), tl.load(s + record.Y, given, 0.0),
        tl.load(s + record.L11, given, 0.0), tl.load(s + record.L21, given, 0.0), tl.load(s + record.L22, given, 0.0),
        tl.load(s + record.LOG2_OPACITY, given, 0.0), tl.load(s + record.CUTOFF, given, 0.0),
        tl.load(s + record.COLOR, given, 0.0), tl.load(s + record.COLOR + 1, given, 0.0),
        tl.load(s + record.COLOR + 2, given, 0.0), tl.load(s + record.DEPTH, given, 0.0),
    )  # fmt: skip
    if GATED:
        held += (tl.load(s + record.GATE, given, 0.0),)
    return held


@jit
def handed(values, lane):
    """The value of one lane, to all pixels of a quadrant [64]."""
    value = tl.gather(values, tl.zeros((WARP,), tl.int32) + lane, 0)
    return tl.reshape(tl.broadcast_to(value[None, :], (PIXELS // WARP, WARP)), (PIXELS,))


@jit
def held_splat(held, lane, GATED: tl.constexpr):
    """As ``load_splat``, of the splat that a lane holds."""
    x, y, l11, l21, l22, log2_opacity, cutoff, red, green, blue, depth = held[:11]
    geometry = (handed(x, lane), handed(y, lane), handed(l11, lane), handed(l21, lane), handed(l22, lane))
    color = (handed(red, lane), handed(green, lane), handed(blue, lane), handed(depth, lane))
    ends = (handed(log2_opacity, lane), handed(cutoff, lane))
    if GATED:
        ends += (handed(held[11], lane),)
    return geometry, ends, color


@jit
def of_lines(y, geometry, log2_opacity, LOWER: tl.constexpr):
    """What the pixels of a line share: dy, its part of (L d)_1, (L d)_2, and the exponent without (L d)_1.

    LOWER: for the lower quadrants.
    """
    dy = y - (geometry[1] - LOWER * SIDE)
    b = geometry[4] * dy
    return dy, geometry[3] * dy, b, log2_opacity - b * b


@jit
def across(x, geometry, line, RIGHT: tl.constexpr):
    """dx and (L d)_1 of a quadrant's pixels; RIGHT: for a right quadrant."""
    dx = x - (geometry[0] - RIGHT * SIDE)
    return dx, geometry[2] * dx + line[1]
