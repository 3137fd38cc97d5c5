"""Backward, from the last splat of a pixel to the first: dLoss/d(ln alpha_k) = w_k f_k - alpha_k / (1 - alpha_k) (light
from behind k), where f = color and depth against the cotangents. The light from behind is summed from the back, its
small terms first, and the transmittance before a splat is that after it / (1 - alpha): both keep their relative digits
however deep the stack. (Total minus prefix, from the front, would carry the rounding of the total to the faintest
splat.) Each pair writes its own slot: no atomics.

A slot holds, with s = dLoss/d(ln alpha), d = (dx, dy), (a, b) = L d and w the blend weight, the sums over pixels of
s, s a, s b; s a dx, s a dy, s b dy (towards l11, l21, l22); |s a|, |s (l21 a + l22 b)|; w times the cotangents.
"""

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.blend import PIXELS, WARP, pairs_of, part_pixels, pixels_of, whitened
from sparsestreet.ops.triton.language import constant, jit

SLOT_LENGTH = 12
SLOT = constant(SLOT_LENGTH)
ZEROED = constant(32)


def registers(depth: bool) -> int:
    """Registers of a lane: the fewest without spills, so that many tiles run at once."""
    return 112 if depth else 104


@jit
def in_lane(values):
    """Sums over the pixels of each lane [32]."""
    return tl.sum(tl.reshape(values, (PIXELS // WARP, WARP)), 0)


@jit
def of_lane(values):
    """What the pixels of each lane share [32]."""
    return tl.max(tl.reshape(values, (PIXELS // WARP, WARP)), 0)


@jit
def store_sums(
    o, s, g, dx, dy, a, b, weight, v_red, v_green, v_blue, v_depth, DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr
):
    """Sums over the tile: first within a lane, whose pixels share y, then over what y alone changes."""
    ga = g * a
    lane_g, lane_ga, lane_b, lane_dy = in_lane(g), in_lane(ga), of_lane(b), of_lane(dy)
    sums = (
        tl.sum(lane_g), tl.sum(lane_ga), tl.sum(lane_g * lane_b),
        tl.sum(in_lane(ga * dx)), tl.sum(lane_ga * lane_dy), tl.sum(lane_g * lane_b * lane_dy),
    )  # fmt: skip
    absolute_x, absolute_y, depth = 0.0, 0.0, 0.0
    if ABSOLUTE:
        absolute_x = tl.sum(in_lane(tl.abs(ga)))
        l21, l22 = tl.load(s + record.L21), tl.load(s + record.L22)
        absolute_y = tl.sum(in_lane(tl.abs(l21 * ga + l22 * (g * b))))
    if DEPTH:
        depth = tl.sum(in_lane(weight * v_depth))
    sums += (
        absolute_x, absolute_y,
        tl.sum(in_lane(weight * v_red)), tl.sum(in_lane(weight * v_green)), tl.sum(in_lane(weight * v_blue)), depth,
    )  # fmt: skip
    # One store for all: as many as there are sums would each take an address of its own.
    field = tl.arange(0, 16)
    values = tl.where(field == 0, sums[0], 0.0)
    for i in tl.static_range(1, SLOT):
        values = tl.where(field == i, sums[i], values)
    tl.store(o + field, values, field < SLOT)


@jit
def zero_slots(slots, pair_slots, begin, end, COUNT: tl.constexpr):
    """Pairs behind the last one that was looked at."""
    for k in range(begin, end, ZEROED):
        pair = k + tl.arange(0, ZEROED)
        to = slots + tl.load(pair_slots + pair, pair < end, 0) * COUNT
        for i in tl.static_range(COUNT):
            tl.store(to + i, 0.0, pair < end)


@jit
def alpha_behind(s, exponent, k, last, alpha_max):
    """Alpha, 0 where the splat was not drawn or the pixel had finished, and 1 / (1 - alpha)."""
    raw = tl.exp2(exponent)
    drawn = (exponent >= tl.load(s + record.CUTOFF)) & (k < last)
    alpha = tl.where(drawn, tl.minimum(raw, alpha_max), 0.0)
    # The device's reciprocal root is good to 2^-22.9; one Newton step, so that no drift builds up over a stack.
    rest = 1.0 - alpha
    root = tl.rsqrt(rest)
    inverse = root * root
    return raw, alpha, tl.fma(tl.fma(-rest, inverse, 1.0), inverse, inverse)


@jit
def from_behind(colors, depths, v_red, v_green, v_blue, v_depth, nexts, part, DEPTH: tl.constexpr):
    """Light of the parts of the tile behind this one, against the cotangents."""
    behind = tl.zeros_like(v_red)
    for after in range(part + 1, tl.load(nexts + part)):
        at = part_pixels(after)
        behind += tl.load(colors + 3 * at) * v_red + tl.load(colors + 3 * at + 1) * v_green
        behind += tl.load(colors + 3 * at + 2) * v_blue
        if DEPTH:
            behind += tl.load(depths + at) * v_depth
    return behind


@jit
def blend_tiles_backward(
    records, pair_rows, pair_slots, begins, ends, order, transmittance, lasts,
    nexts, part_rgb, part_depth, part_transmittance, part_lasts,
    v_rgb, v_transmittance, v_depth_sum, slots, width, height, tiles_x, alpha_max,
    DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr, PARTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the slots of all pairs of one tile, with PARTS of one part of a tile.

    ABSOLUTE: the absolute gradients as well; DEPTH: v_depth_sum is given.
    """
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    at = y * width + x
    v_red = tl.load(v_rgb + 3 * at, inside, 0.0)
    v_green = tl.load(v_rgb + 3 * at + 1, inside, 0.0)
    v_blue = tl.load(v_rgb + 3 * at + 2, inside, 0.0)
    v_depth = tl.load(v_depth_sum + at, inside, 0.0) if DEPTH else v_red
    passed = tl.load(transmittance + at, inside, 0.0)
    behind = passed * tl.load(v_transmittance + at, inside, 0.0)
    begin, end = pairs_of(tile, begins, ends, PARTS)
    if PARTS:
        part = tl.program_id(0)
        behind += from_behind(part_rgb, part_depth, v_red, v_green, v_blue, v_depth, nexts, part, DEPTH)
        at = part_pixels(part)
        passed, last = tl.load(part_transmittance + at), tl.load(part_lasts + at)
    else:
        last = tl.load(lasts + at, inside, begin)
    # Of a split tile no pair is this program's: its ``lasts`` are those of the parts put together.
    latest = tl.minimum(tl.max(last), end)
    zero_slots(slots, pair_slots, latest, end, SLOT)
    for i in range(latest - begin):
        k = latest - 1 - i
        s = record.record_of(records, tl.load(pair_rows + k))
        dx, dy, a, b, exponent = whitened(s, px, py)
        raw, alpha, inverse = alpha_behind(s, exponent, k, last, alpha_max)
        passed *= inverse
        weight = alpha * passed
        light = tl.load(s + record.COLOR) * v_red + tl.load(s + record.COLOR + 1) * v_green
        light += tl.load(s + record.COLOR + 2) * v_blue
        if DEPTH:
            light += tl.load(s + record.DEPTH) * v_depth
        blended = weight * light
        # A clamped alpha has no derivative.
        g = tl.where(raw <= alpha_max, blended - alpha * inverse * behind, 0.0)
        behind += blended
        o = slots + tl.load(pair_slots + k) * SLOT
        store_sums(o, s, g, dx, dy, a, b, weight, v_red, v_green, v_blue, v_depth, DEPTH, ABSOLUTE)
