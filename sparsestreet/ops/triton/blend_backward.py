"""Backward, front to back again: dLoss/d(ln alpha_k) = w_k f_k - alpha_k / (1 - alpha_k) (light still behind k), where
f = colour and depth against the cotangents and the light behind is the pixel's total minus the prefix. Nothing is
divided out of the transmittance, so saturated pixels keep their digits. Each pair writes its own slot: no atomics.

A slot holds, with s = dLoss/d(ln alpha), d = (dx, dy), (a, b) = L d and w the blend weight, the sums over pixels of
s, s a, s b; s a dx, s a dy, s b dy (towards l11, l21, l22); |s a|, |s (l21 a + l22 b)|; w times the cotangents.
"""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.blend import blend_weight, pixels_of, whitened
from sparsestreet.ops.triton.language import constant, jit

SLOT_LENGTH = 12
SLOT = constant(SLOT_LENGTH)
ZEROED = constant(32)


def registers(depth: bool, exclusive: bool) -> int:
    """Registers of a lane: the fewest without spills, so that many tiles run at once."""
    return 128 if exclusive else 112 if depth else 96


@jit
def store_sums(
    o, s, g, dx, dy, a, b, weight, v_red, v_green, v_blue, v_depth, DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr
):
    """Sums over the tile: first along x, within a lane, then over y what only y changes."""
    ga = g * a
    line_g, line_ga = tl.sum(g, 0), tl.sum(ga, 0)
    line_b, line_dy = tl.sum(b, 0), tl.sum(dy, 0)
    sums = (
        tl.sum(line_g), tl.sum(line_ga), tl.sum(line_g * line_b),
        tl.sum(tl.sum(ga * dx, 0)), tl.sum(line_ga * line_dy), tl.sum(line_g * line_b * line_dy),
    )  # fmt: skip
    absolute_x, absolute_y, depth = 0.0, 0.0, 0.0
    if ABSOLUTE:
        absolute_x = tl.sum(tl.sum(tl.abs(ga), 0))
        l21, l22 = tl.load(s + record.L21), tl.load(s + record.L22)
        absolute_y = tl.sum(tl.sum(tl.abs(l21 * ga + l22 * (g * b)), 0))
    if DEPTH:
        depth = tl.sum(tl.sum(weight * v_depth, 0))
    sums += (
        absolute_x, absolute_y,
        tl.sum(tl.sum(weight * v_red, 0)), tl.sum(tl.sum(weight * v_green, 0)), tl.sum(tl.sum(weight * v_blue, 0)),
        depth,
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


@partial(jit, do_not_specialize=["step"])
def blend_tiles_backward(
    records, pair_rows, pair_slots, begins, ends, lasts, order, rgb, transmittance, depth_sum,
    v_rgb, v_transmittance, v_depth_sum, slots, width, height, step, tiles_x, alpha_max, transmittance_min,
    EXCLUSIVE: tl.constexpr, DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the slots of all pairs of one tile. ABSOLUTE: the absolute gradients as well; DEPTH: v_depth_sum is given.

    ``step`` is 1, and the compiler must not know: for neighbouring pixels it would load in another layout than the one
    it sums in, and compile the loop twice into one.
    """
    tl.static_assert(BLOCK == 1)
    tile = tl.load(order + tl.program_id(0))
    x, y, inside = pixels_of(tile, width, height, tiles_x)
    px, py = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    at = y * width + x * step
    v_red = tl.load(v_rgb + 3 * at, inside, 0.0)
    v_green = tl.load(v_rgb + 3 * at + 1, inside, 0.0)
    v_blue = tl.load(v_rgb + 3 * at + 2, inside, 0.0)
    v_depth = v_red
    behind = tl.load(rgb + 3 * at, inside, 0.0) * v_red + tl.load(rgb + 3 * at + 1, inside, 0.0) * v_green
    behind += tl.load(rgb + 3 * at + 2, inside, 0.0) * v_blue
    behind += tl.load(transmittance + at, inside, 0.0) * tl.load(v_transmittance + at, inside, 0.0)
    if DEPTH:
        v_depth = tl.load(v_depth_sum + at, inside, 0.0)
        behind += tl.load(depth_sum + at, inside, 0.0) * v_depth
    passed = tl.where(inside, 1.0, 0.0)
    gate = passed
    last = tl.load(lasts + tile)
    zero_slots(slots, pair_slots, last, tl.load(ends + tile), SLOT)
    for k in range(tl.load(begins + tile), last):
        s = record.record_of(records, tl.load(pair_rows + k))
        dx, dy, a, b, exponent = whitened(s, px, py)
        raw = tl.exp2(exponent)
        alpha, gate = blend_weight(s, exponent, raw, passed, gate, alpha_max, transmittance_min, EXCLUSIVE)
        weight = alpha * passed
        passed -= weight
        light = tl.load(s + record.COLOR) * v_red + tl.load(s + record.COLOR + 1) * v_green
        light += tl.load(s + record.COLOR + 2) * v_blue
        if DEPTH:
            light += tl.load(s + record.DEPTH) * v_depth
        blended = weight * light
        behind -= blended
        # 1 / (1 - alpha) without the scaling a division would take to guard its range.
        root = tl.rsqrt(1.0 - alpha)
        g = blended - alpha * (root * root) * behind
        # A clamped alpha has no derivative.
        g = tl.where(raw <= alpha_max, g, 0.0)
        o = slots + tl.load(pair_slots + k) * SLOT
        store_sums(o, s, g, dx, dy, a, b, weight, v_red, v_green, v_blue, v_depth, DEPTH, ABSOLUTE)
