"""Forward: each tile's splats, nearest first, into its 256 pixels.

One warp per tile (or per part of a long one, parts.py) holds 8 pixels per lane in registers and walks the splats one by
one; every number of a splat is one load for all lanes. A lane's pixels lie in one line, so that everything that only y
changes is computed once. They are one axis of 256: of two axes each version of the compiler would choose the lanes'
pixels for itself, and some choose columns. Registers and instructions are bounded in
tests/ops/triton/test_machine_code.py.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.view import TILE

PIXEL_COUNT = 256
PIXELS = constant(PIXEL_COUNT)
WARP = constant(32)
# Pairs between two looks at whether the whole tile is finished.
LOOK_LENGTH = 32
LOOK = constant(LOOK_LENGTH)


def registers(lasts: bool, exclusive: bool) -> int:
    """Registers of a lane: the fewest without spills, so that many tiles run at once."""
    return 88 if lasts or exclusive else 80


@jit
def pixels_of(tile, width, height, tiles_x):
    """Columns and lines of a tile's pixels, and which of them lie in the image; all [256].

    Of 32 neighbors each lane gets one: its 8 pixels lie in one line, two columns apart.
    """
    p = tl.arange(0, PIXELS)
    x = (tile % tiles_x) * TILE + (p // WARP) * (WARP // TILE) + p % WARP // TILE
    y = (tile // tiles_x) * TILE + p % TILE
    return x, y, (x < width) & (y < height)


@jit
def part_pixels(part):
    """Places of a part's pixels in the layers of all parts [256]: line by line, as in the image."""
    p = tl.arange(0, PIXELS)
    return part * PIXELS + p % TILE * TILE + (p // WARP) * (WARP // TILE) + p % WARP // TILE


@jit
def pairs_of(tile, begins, ends, PARTS: tl.constexpr):
    """First pair, and the one after the last, of this program's tile or part of one."""
    if PARTS:
        tile = tl.program_id(0)
    return tl.load(begins + tile), tl.load(ends + tile)


@jit
def whitened(s, px, py):
    """d = pixel - mean along both axes, L d, and log2 of alpha before the clamp; all [256]."""
    dx, dy = px - tl.load(s + record.X), py - tl.load(s + record.Y)
    b = tl.load(s + record.L22) * dy
    a = tl.load(s + record.L11) * dx + tl.load(s + record.L21) * dy
    return dx, dy, a, b, tl.load(s + record.LOG2_OPACITY) - b * b - a * a


@jit
def blend_one(s, px, py, passed, alpha_max, transmittance_min, EXCLUSIVE: tl.constexpr):
    """Blend weight of a splat, the light that gets past it, and which pixels were open to it.

    A pixel is finished for good where ``passed`` is at most ``transmittance_min``. The exclusive stop drops the splat
    that would cross that limit and marks the pixel by the sign: the light itself stays above.
    """
    _, _, _, _, exponent = whitened(s, px, py)
    alpha = tl.minimum(tl.exp2(exponent), alpha_max)
    drawn = exponent >= tl.load(s + record.CUTOFF)
    if EXCLUSIVE:
        weight = tl.where(drawn, alpha, 0.0) * passed
        rest = passed - weight
        still = rest > transmittance_min
        weight = tl.where(still, weight, 0.0)
        rest = tl.where(still, rest, -tl.abs(passed))
    else:
        still = passed > transmittance_min
        weight = tl.where(drawn & still, alpha, 0.0) * passed
        rest = passed - weight
    return weight, rest, still


@jit
def open_before(products, firsts, part, inside, PARTS: tl.constexpr):
    """What reaches a tile, or gets past the parts of the tile before this one; pixels outside are finished at once."""
    passed = tl.where(inside, 1.0, 0.0)
    if PARTS:
        for before in range(tl.load(firsts + part), part):
            passed *= tl.load(products + part_pixels(before))
    return passed


@jit
def blend_tiles(
    records, pair_rows, begins, ends, order, firsts, products, rgb, transmittance, depth_sum, lasts,
    width, height, tiles_x, alpha_max, transmittance_min,
    EXCLUSIVE: tl.constexpr, DEPTH: tl.constexpr, LASTS: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes every pixel of one tile; with PARTS of one part of a tile, into the layers of parts (parts.py).

    ``lasts`` (if LASTS): the index after the last pair that a pixel was open to, where backward begins.
    """
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    k, end = pairs_of(tile, begins, ends, PARTS)
    passed = open_before(products, firsts, tl.program_id(0), inside, PARTS)
    red, green, blue = tl.zeros_like(passed), tl.zeros_like(passed), tl.zeros_like(passed)
    depth, last = tl.zeros_like(passed), tl.zeros_like(passed).to(tl.int32) + k
    unfinished = (k < end) & (tl.max(passed) > transmittance_min)
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        for i in range(k, stop):
            s = record.record_of(records, tl.load(pair_rows + i))
            weight, passed, still = blend_one(s, px, py, passed, alpha_max, transmittance_min, EXCLUSIVE)
            red += weight * tl.load(s + record.COLOR)
            green += weight * tl.load(s + record.COLOR + 1)
            blue += weight * tl.load(s + record.COLOR + 2)
            if DEPTH:
                depth += weight * tl.load(s + record.DEPTH)
            if LASTS:
                last = tl.where(still, i + 1, last)
        k = stop
        unfinished = (k < end) & (tl.max(passed) > transmittance_min)
    # Volatile: the compiler must compute places anew instead of holding registers for them through the loop.
    tile = tl.load(order + tl.program_id(0), volatile=True)
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    at = y * width + x
    if PARTS:
        # Pixels outside have a place too, and are written, for they are read.
        at, inside = part_pixels(tl.program_id(0)), inside | True
    tl.store(rgb + 3 * at, red, inside)
    tl.store(rgb + 3 * at + 1, green, inside)
    tl.store(rgb + 3 * at + 2, blue, inside)
    tl.store(transmittance + at, tl.abs(passed), inside)
    if DEPTH:
        tl.store(depth_sum + at, depth, inside)
    if LASTS:
        tl.store(lasts + at, last, inside)
