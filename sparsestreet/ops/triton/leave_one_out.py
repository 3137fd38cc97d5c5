"""How much a view changes when one row alone is removed.

A pixel is linear in the alpha of each of its splats, so the change is exactly
-alpha dC/dalpha = -w c + (light behind) alpha / (1 - alpha). Like backward it runs from the back to the front.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.blend import pixels_of, whitened
from sparsestreet.ops.triton.blend_backward import drawn_alpha, inverse_rest, zero_slots
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.quadrants import row_of

CHANGE_COUNT = 2
CHANGES = constant(CHANGE_COUNT)


@jit
def light_of(background, passed, at, inside, CHANNEL: tl.constexpr, BEHIND: tl.constexpr):
    """One channel of the background's light that passes all splats."""
    light = tl.zeros_like(passed)
    if BEHIND:
        light = passed * tl.load(background + 3 * at + CHANNEL, inside, 0.0)
    return light


@jit
def change_of(behind, own, through):
    """The change of the channel without the splat, and the light behind the one before it."""
    return behind * through - own, behind + own


@jit
def remove_from_tiles(
    records, pair_rows, pair_slots, begins, ends, lasts, order, transmittance, background, pixel_weights, slots,
    width, height, tiles_x, alpha_max,
    BEHIND: tl.constexpr, WEIGHTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the slots of all pairs of one tile: largest change, sum of squares."""
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    at = y * width + x
    passed = tl.load(transmittance + at, inside, 0.0)
    red = light_of(background, passed, at, inside, 0, BEHIND)
    green = light_of(background, passed, at, inside, 1, BEHIND)
    blue = light_of(background, passed, at, inside, 2, BEHIND)
    counts = tl.load(pixel_weights + at, inside, 0.0) if WEIGHTED else 1.0
    begin = tl.load(begins + tile)
    last = tl.load(lasts + at, inside, begin)
    latest = tl.max(last)
    zero_slots(slots, pair_slots, latest, tl.load(ends + tile), CHANGES)
    for i in range(latest - begin):
        k = latest - 1 - i
        s = record.record_of(records, row_of(tl.load(pair_rows + k)))
        _, _, _, _, exponent = whitened(s, px, py)
        _, alpha = drawn_alpha(exponent, tl.load(s + record.CUTOFF), k, last, alpha_max)
        inverse = inverse_rest(alpha)
        passed *= inverse
        weight, through = alpha * passed, alpha * inverse
        of_red, red = change_of(red, weight * tl.load(s + record.COLOR), through)
        of_green, green = change_of(green, weight * tl.load(s + record.COLOR + 1), through)
        of_blue, blue = change_of(blue, weight * tl.load(s + record.COLOR + 2), through)
        largest = tl.maximum(tl.maximum(tl.abs(of_red), tl.abs(of_green)), tl.abs(of_blue))
        o = slots + tl.load(pair_slots + k) * CHANGES
        tl.store(o, tl.max(largest))
        tl.store(o + 1, tl.sum(counts * (of_red * of_red + of_green * of_green + of_blue * of_blue)))
