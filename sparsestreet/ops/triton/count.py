"""What each row adds to a view: sum of weights, touched pixels, dominated pixels.

It is a separate pass, so that training does not pay for it. Like backward it writes slots instead of using atomics.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.blend import blend_one, pixels_of, whitened
from sparsestreet.ops.triton.blend_backward import zero_slots
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.quadrants import row_of
from sparsestreet.ops.triton.thin import LOOK

COUNTER_COUNT = 3
COUNTERS = constant(COUNTER_COUNT)


@jit
def count_tiles_pixels(
    records, pair_rows, pair_slots, begins, ends, order, slots,
    width, height, tiles_x, alpha_max, transmittance_min, EXCLUSIVE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the slots of all pairs of one tile: weight, pixels, dominated pixels."""
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    passed = tl.where(inside, 1.0, 0.0)
    best, best_pair = tl.zeros_like(passed), tl.zeros_like(passed).to(tl.int32) - 1
    begin, end = tl.load(begins + tile), tl.load(ends + tile)
    k = begin
    unfinished = k < end
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        for i in range(k, stop):
            s = record.record_of(records, row_of(tl.load(pair_rows + i)))
            _, _, _, _, exponent = whitened(s, px, py)
            cutoff = tl.load(s + record.CUTOFF)
            alpha = tl.minimum(tl.exp2(exponent), alpha_max)
            weight, passed, _ = blend_one(alpha, exponent >= cutoff, passed, transmittance_min, EXCLUSIVE)
            # Strictly more, so that of equal weights the nearer splat keeps the pixel.
            more = weight > best
            best, best_pair = tl.where(more, weight, best), tl.where(more, i, best_pair)
            o = slots + tl.load(pair_slots + i) * COUNTERS
            tl.store(o, tl.sum(weight))
            tl.store(o + 1, tl.sum((weight > 0).to(tl.float32)))
        k = stop
        unfinished = (k < end) & (tl.max(passed) > transmittance_min)
    for i in range(begin, k):
        tl.store(slots + tl.load(pair_slots + i) * COUNTERS + 2, tl.sum((best_pair == i).to(tl.float32)))
    zero_slots(slots, pair_slots, k, end, COUNTERS)
