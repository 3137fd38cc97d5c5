"""Forward: each tile's splats, nearest first, into its 256 pixels.

One warp per tile holds 8 pixels per lane in registers and walks the splats one by one; every number of a splat is one
load for all lanes. Pixels lie on the axes (x, y), so that a lane's pixels share y and everything that only y changes
is computed once. Registers and instructions are bounded in tests/ops/triton/test_machine_code.py.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.view import TILE

# Pairs between two looks at whether the whole tile is finished.
LOOK = constant(32)


@jit
def pixels_of(tile, width, height, tiles_x):
    """Columns [16, 1] and lines [1, 16] of a tile, and which of its pixels lie in the image [16, 16]."""
    x = (tile % tiles_x) * TILE + tl.arange(0, TILE)[:, None]
    y = (tile // tiles_x) * TILE + tl.arange(0, TILE)[None, :]
    return x, y, (x < width) & (y < height)


@jit
def whitened(s, px, py):
    """d = pixel - mean along both axes, L d, and log2 of alpha before the clamp, all over [16, 16] or broadcast."""
    dx, dy = px - tl.load(s + record.X), py - tl.load(s + record.Y)
    b = tl.load(s + record.L22) * dy
    a = tl.load(s + record.L11) * dx + tl.load(s + record.L21) * dy
    return dx, dy, a, b, tl.load(s + record.LOG2_OPACITY) - b * b - a * a


@jit
def blend_weight(s, exponent, raw, transmittance, gate, alpha_max, transmittance_min, EXCLUSIVE: tl.constexpr):
    """Alpha (0 below the cut-off and in finished pixels) and the gate after it.

    ``gate`` is the product that includes dropped splats; only the exclusive stop looks at it.
    """
    alpha = tl.minimum(raw, alpha_max)
    cutoff = tl.load(s + record.CUTOFF)
    if EXCLUSIVE:
        alpha = tl.where(exponent >= cutoff, alpha, 0.0)
        gate -= alpha * gate
        alpha = tl.where(gate > transmittance_min, alpha, 0.0)
    else:
        alpha = tl.where((exponent >= cutoff) & (transmittance > transmittance_min), alpha, 0.0)
    return alpha, gate


@jit
def blend_tiles(
    records, pair_rows, begins, ends, order, rgb, transmittance, depth_sum, lasts,
    width, height, tiles_x, alpha_max, transmittance_min,
    EXCLUSIVE: tl.constexpr, DEPTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes every pixel of one tile, and in ``lasts`` the index after the last pair that was looked at."""
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    # Pixels outside are finished from the start.
    passed = tl.where(inside, 1.0, 0.0)
    gate = passed
    red, green, blue = tl.zeros_like(passed), tl.zeros_like(passed), tl.zeros_like(passed)
    depth = tl.zeros_like(passed)
    k, end = tl.load(begins + tile), tl.load(ends + tile)
    unfinished = k < end
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        for i in range(k, stop):
            s = record.record_of(records, tl.load(pair_rows + i))
            _, _, _, _, exponent = whitened(s, px, py)
            alpha, gate = blend_weight(
                s, exponent, tl.exp2(exponent), passed, gate, alpha_max, transmittance_min, EXCLUSIVE
            )
            weight = alpha * passed
            passed -= weight
            red += weight * tl.load(s + record.COLOR)
            green += weight * tl.load(s + record.COLOR + 1)
            blue += weight * tl.load(s + record.COLOR + 2)
            if DEPTH:
                depth += weight * tl.load(s + record.DEPTH)
        k = stop
        still = gate if EXCLUSIVE else passed
        unfinished = (k < end) & (tl.max(still) > transmittance_min)
    # Volatile: the compiler must compute places anew instead of holding registers for them through the loop.
    tile = tl.load(order + tl.program_id(0), volatile=True)
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    at = y * width + x
    tl.store(rgb + 3 * at, red, inside)
    tl.store(rgb + 3 * at + 1, green, inside)
    tl.store(rgb + 3 * at + 2, blue, inside)
    tl.store(transmittance + at, passed, inside)
    if DEPTH:
        tl.store(depth_sum + at, depth, inside)
    tl.store(lasts + tile, k)
