"""Finds the 16x16 tiles a splat can touch: per row of tiles, the columns that its ellipse |L d|^2 <= reach touches.

The counting and the listing kernel both compute this from the record alone. Both are compiled without fused
multiply-adds, so they cannot disagree.
"""

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.view import TILE

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
