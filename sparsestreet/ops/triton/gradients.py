"""Backward: pixels to a slot per pair, slots to rows, rows to parameters."""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import view as record
from sparsestreet.ops.triton.blend import (
    WARP,
    across,
    centers,
    lane_sum,
    load_splat,
    of_lane,
    of_lines,
    part_places,
    quadrant_places,
    row_of,
    touches,
    work_of,
)
from sparsestreet.ops.triton.cameras import (
    pinhole,
    pinhole_backward,
    roll,
    roll_backward,
    unscented,
    unscented_backward,
    velocity,
    velocity_backward,
)
from sparsestreet.ops.triton.launch import constant, jit
from sparsestreet.ops.triton.project import (
    LOG2_SCALE,
    TWO_LN2,
    axes_backward,
    blurred,
    camera_axes,
    coefficients_of,
    color_backward,
    compensation,
    conic_backward,
)
from sparsestreet.ops.triton.quaternions import load_row, plus, store_row, times, transposed_times, unit_quaternion
from sparsestreet.ops.triton.view import (
    ROTATION,
    TILE,
    KernelView,
    in_camera,
    load_columns,
    load_matrix,
    store_columns,
    store_harmonics,
)

SLOT_LENGTH, GATED_SLOT_LENGTH = 12, 16
SLOT, GATED_SLOT = constant(SLOT_LENGTH), constant(GATED_SLOT_LENGTH)
GATE_PLACE = 12
ZEROED = constant(16)


def registers(depth: bool, gated: bool) -> int:
    """Fewest registers of a lane without spills. A multiprocessor runs 20 warps with up to 96 registers, 16 with
    128."""
    return (104 if depth else 96) + 8 * gated


def slot_length(gated: bool) -> int:
    """Numbers of a slot, and of a row's sums."""
    return GATED_SLOT_LENGTH if gated else SLOT_LENGTH


@jit
def halved(low, high, lane, BIT: tl.constexpr):
    """Lanes without BIT return ``low``, those with it ``high``, each plus the same value of its partner lane."""
    upper = (lane & BIT) != 0
    return tl.where(upper, high, low) + tl.gather(tl.where(upper, low, high), lane ^ BIT, 0)


@jit
def store_sums(to, s, GATED: tl.constexpr):
    """Store the sums over the warp of each lane's twelve numbers, added in a fixed order; GATED: and of a thirteenth.

    Every exchange between lanes halves how many numbers a lane still holds. This takes 13 exchanges, or 15; summing
    each number alone would take 60."""
    lane = tl.arange(0, WARP)
    s0, s1, s2 = halved(s[0], s[6], lane, 16), halved(s[1], s[7], lane, 16), halved(s[2], s[8], lane, 16)
    s3, s4, s5 = halved(s[3], s[9], lane, 16), halved(s[4], s[10], lane, 16), halved(s[5], s[11], lane, 16)
    s0, s1, s2 = halved(s0, s3, lane, 8), halved(s1, s4, lane, 8), halved(s2, s5, lane, 8)
    s0 = halved(s0, s1, lane, 4)
    if GATED:
        gate = s[12] + tl.gather(s[12], lane ^ 16, 0)
        s2 = halved(s2, gate + tl.gather(gate, lane ^ 8, 0), lane, 4)
    else:
        s2 += tl.gather(s2, lane ^ 4, 0)
    s0 = halved(s0, s2, lane, 2)
    s0 += tl.gather(s0, lane ^ 1, 0)
    third = (lane & 2) != 0
    field = 6 * (lane // 16) + 3 * (lane // 8 % 2) + tl.where(third, 2, lane // 4 % 2)
    fourth = (lane & 6) == 6
    if GATED:
        tl.store(to + tl.where(fourth, 12 + lane // 8, field), s0, (lane & 1) == 0)
    else:
        tl.store(to + field, s0, ((lane & 1) == 0) & (fourth == 0))


@jit
def zero_slots(slots, pair_slots, begin, end, COUNT: tl.constexpr):
    """Zeroes the slots of pairs after the last visited one (most pairs in a closed tile); adjacent lanes share a
    slot."""
    field = tl.arange(0, 16)[None, :]
    for k in range(begin, end, ZEROED):
        pair = k + tl.arange(0, ZEROED)
        to = slots + tl.load(pair_slots + pair, pair < end, 0)[:, None] * COUNT + field
        tl.store(to, tl.zeros((ZEROED, 16), tl.float32), (pair < end)[:, None] & (field < COUNT))


@jit
def drawn_alpha(exponent, cutoff, k, last, alpha_max):
    """Alpha before and after the clamp; then 0 where the splat was not drawn or the pixel had finished."""
    raw = tl.exp2(exponent)
    drawn = (exponent >= cutoff) & (k < last)
    return raw, tl.where(drawn, tl.minimum(raw, alpha_max), 0.0)


@jit
def inverse_rest(alpha):
    """1 / (1 - alpha)."""
    # The device's reciprocal root is exact to 2^-22.9. One Newton step keeps errors from adding up over a stack.
    rest = 1.0 - alpha
    root = tl.rsqrt(rest)
    inverse = root * root
    return tl.fma(tl.fma(-rest, inverse, 1.0), inverse, inverse)


@jit
def light_behind(part_rgb, part_depth, part, following, v, at, DEPTH: tl.constexpr):
    """Light of the tile's parts behind this one, before ``following``, times the cotangents; ``at``: indices in this
    part's layer."""
    light = tl.zeros_like(v[0])
    for after in range(part + 1, following):
        to = at + (after - part) * TILE * TILE
        light += tl.load(part_rgb + 3 * to) * v[0] + tl.load(part_rgb + 3 * to + 1) * v[1]
        light += tl.load(part_rgb + 3 * to + 2) * v[2]
        if DEPTH:
            light += tl.load(part_depth + to) * v[3]
    return light


@jit
def last_quadrant(
    tile, transmittance, lasts, v_rgb, v_transmittance, v_depth_sum, begin,
    part, following, is_part, part_rgb, part_depth, part_transmittance, part_lasts, width, height, tiles_x,
    QUADRANT: tl.constexpr, DEPTH: tl.constexpr, TOGETHER: tl.constexpr,
):  # fmt: skip
    """A quadrant after its last splat: the light left, and the light behind times the cotangents.

    Then what stays the same: the cotangents of color and depth, and the index after the last pair of each pixel."""
    at, inside = quadrant_places(tile, width, height, tiles_x, QUADRANT)
    red = tl.load(v_rgb + 3 * at, inside, 0.0)
    green = tl.load(v_rgb + 3 * at + 1, inside, 0.0)
    blue = tl.load(v_rgb + 3 * at + 2, inside, 0.0)
    v = (red, green, blue, tl.load(v_depth_sum + at, inside, 0.0) if DEPTH else red)
    passed = tl.load(transmittance + at, inside, 0.0)
    behind = passed * tl.load(v_transmittance + at, inside, 0.0)
    if TOGETHER:
        to = part_places(part, QUADRANT)
        behind += light_behind(part_rgb, part_depth, part, following, v, to, DEPTH)
    last = tl.load(lasts + at, inside, begin)
    if TOGETHER:
        passed, last = tl.load(part_transmittance + to, is_part, passed), tl.load(part_lasts + to, is_part, last)
    return (passed, behind), v, last


@jit
def differentiate_quadrant(
    touched, quadrant, v, last, sums, x, line, RIGHT: tl.constexpr, splat, k, alpha_max,
    DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr, GATED: tl.constexpr,
):  # fmt: skip
    """The quadrant before a splat, and the splat's sums with this quadrant's added.

    Within a lane, whose pixels share y, the sums cover everything that depends on x."""
    passed, behind = quadrant
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12 = sums
    if touched:
        geometry, ends, light = splat
        dy, _, b, base = line
        dx, a = across(x, geometry, line, RIGHT)
        raw, own = drawn_alpha(base - a * a, ends[1], k, last, alpha_max)
        alpha = own * ends[2] if GATED else own
        inverse = inverse_rest(alpha)
        passed *= inverse
        weight = alpha * passed
        shown = light[0] * v[0] + light[1] * v[1] + light[2] * v[2]
        if DEPTH:
            shown += light[3] * v[3]
        blended = weight * shown
        # A clamped alpha has no derivative.
        g = tl.where(raw <= alpha_max, blended - alpha * inverse * behind, 0.0)
        if GATED:
            s12 += lane_sum(own * (passed * shown - inverse * behind))
        behind += blended
        ga = g * a
        lane_g, lane_ga, lane_dy = lane_sum(g), lane_sum(ga), of_lane(dy)
        lane_gb = lane_g * of_lane(b)
        s0, s1, s2 = s0 + lane_g, s1 + lane_ga, s2 + lane_gb
        s3, s4, s5 = s3 + lane_sum(ga * dx), s4 + lane_ga * lane_dy, s5 + lane_gb * lane_dy
        if ABSOLUTE:
            s6 += lane_sum(tl.abs(ga))
            s7 += lane_sum(tl.abs(geometry[3] * ga + geometry[4] * (g * b)))
        s8, s9 = s8 + lane_sum(weight * v[0]), s9 + lane_sum(weight * v[1])
        s10 += lane_sum(weight * v[2])
        if DEPTH:
            s11 += lane_sum(weight * v[3])
    return (passed, behind), (s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12)


@partial(jit, do_not_specialize=["width", "height", "tiles_x", "part_count"])
def blend_tiles_backward(
    records, pair_rows, pair_slots, begins, ends, order, ahead, part_tiles, part_begins, part_ends, nexts,
    transmittance, lasts, part_rgb, part_depth, part_transmittance, part_lasts,
    v_rgb, v_transmittance, v_depth_sum, slots, width, height, tiles_x, part_count, alpha_max,
    DEPTH: tl.constexpr, ABSOLUTE: tl.constexpr, TOGETHER: tl.constexpr, GATED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the slots of all pairs of one tile, or (TOGETHER) of one part of a tile.

    ABSOLUTE: the absolute gradients as well; DEPTH: v_depth_sum is given; GATED: rows have gates, slots
    also the sums for these.
    """
    tl.static_assert(BLOCK == 1)
    length: tl.constexpr = GATED_SLOT if GATED else SLOT
    tables = (begins, ends, order, ahead, part_tiles, part_begins, part_ends, part_count)
    tile, part, begin, end, is_part = work_of(*tables, False, TOGETHER)
    following = part
    if TOGETHER:
        following = tl.load(nexts + part, is_part, 0)
    given = (tile, transmittance, lasts, v_rgb, v_transmittance, v_depth_sum, begin)
    of_part = (part, following, is_part, part_rgb, part_depth, part_transmittance, part_lasts)
    size = (width, height, tiles_x)
    q0, v0, last0 = last_quadrant(*given, *of_part, *size, 0, DEPTH, TOGETHER)
    q1, v1, last1 = last_quadrant(*given, *of_part, *size, 1, DEPTH, TOGETHER)
    q2, v2, last2 = last_quadrant(*given, *of_part, *size, 2, DEPTH, TOGETHER)
    q3, v3, last3 = last_quadrant(*given, *of_part, *size, 3, DEPTH, TOGETHER)
    x, y = centers(tile, tiles_x)
    latest = tl.max(tl.maximum(tl.maximum(last0, last1), tl.maximum(last2, last3)))
    # A split tile leaves no pair to this program: its ``lasts`` are those of all parts together. A part that is not
    # needed has written nothing.
    latest = tl.maximum(tl.minimum(latest, end), begin)
    zero_slots(slots, pair_slots, latest, end, length)
    pair = tl.load(pair_rows + latest - 1, latest > begin, 0)
    k = latest - 1
    while k >= begin:
        splat, touched = load_splat(records, row_of(pair), GATED), pair
        pair = tl.load(pair_rows + k - 1, k > begin, 0)
        nothing = tl.zeros((WARP,), tl.float32)
        s = (nothing, nothing, nothing, nothing, nothing, nothing)
        s = s + s + (nothing,)
        more = (splat, k, alpha_max, DEPTH, ABSOLUTE)
        line = of_lines(y, splat[0], splat[1][0], 0)
        q0, s = differentiate_quadrant(touches(touched, 0), q0, v0, last0, s, x, line, 0, *more, GATED)
        q1, s = differentiate_quadrant(touches(touched, 1), q1, v1, last1, s, x, line, 1, *more, GATED)
        line = of_lines(y, splat[0], splat[1][0], 1)
        q2, s = differentiate_quadrant(touches(touched, 2), q2, v2, last2, s, x, line, 0, *more, GATED)
        q3, s = differentiate_quadrant(touches(touched, 3), q3, v3, last3, s, x, line, 1, *more, GATED)
        store_sums(slots + tl.load(pair_slots + k) * length, s, GATED)
        k -= 1


ROWS = 16
"""Rows of a program. Four neighboring lanes take a row's numbers, four at a time."""
OPTIONS = {"num_warps": 2}
STEP = constant(4)
"""Number of slots of a row that are loaded together."""


@partial(jit, do_not_specialize=["visible"])
def sum_slots(
    slots, rows, row_ends, tile_counts, sums, visible,
    COUNT: tl.constexpr, PADDED: tl.constexpr, SUM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``sums[row, :COUNT]`` of each visible row, in the type SUM; PADDED: COUNT rounded up to a power of two.

    ``visible`` may be room for more: behind the last visible row counts are 0."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = rank < visible
    count = tl.load(tile_counts + rank, given, 0)
    first = (tl.load(row_ends + rank, given, 0) - count).to(tl.int64)
    field = tl.arange(0, PADDED)
    slot = slots + first[:, None] * COUNT + field[None, :]
    total = tl.zeros((BLOCK, PADDED), SUM)
    for k in range(0, tl.max(count, 0), STEP):
        wanted, values = (), ()
        for i in tl.static_range(STEP):
            wanted += (k + i < count,)
        for i in tl.static_range(STEP):
            mask = wanted[i][:, None] & (field < COUNT)[None, :]
            values += (tl.load(slot + (k + i) * COUNT, mask, 0.0),)
        for i in tl.static_range(STEP):
            total += values[i].to(SUM)
    row = tl.load(rows + rank, given, 0).to(tl.int64)
    tl.store(sums + row[:, None] * COUNT + field[None, :], total, (count > 0)[:, None] & (field < COUNT)[None, :])


def block_of(view: KernelView) -> int:
    """Rows of a program. 16 distorted rows of eight points take as many lanes as 128 others, so none spills
    registers."""
    return 16 if view.distorted else 128


@jit
def lens_shape(view, mean, axes, DISTORTED: tl.constexpr):
    return unscented(view, mean, axes) if DISTORTED else pinhole(view, mean, axes)


@jit
def lens_backward(view, mean, axes, v, DISTORTED: tl.constexpr):
    return unscented_backward(view, mean, axes, v) if DISTORTED else pinhole_backward(view, mean, axes, v)


@jit
def screen_gradient(s, to, mask):
    """A row's sums over pixels (blend_backward.py) in natural units (exponent -|L d|^2 / 2).

    Returns the gradients of the mean, their absolute values, and those of (l11, l21, l22) and the effective opacity.
    """
    l11, l21 = tl.load(to + record.L11, mask, 1.0), tl.load(to + record.L21, mask, 0.0)
    l22, log2_opacity = tl.load(to + record.L22, mask, 1.0), tl.load(to + record.LOG2_OPACITY, mask, 0.0)
    v_mean = (TWO_LN2 * l11 * s[1], TWO_LN2 * (l21 * s[1] + l22 * s[2]))
    v_absolute = (TWO_LN2 * l11 * s[6], TWO_LN2 * s[7])
    k = -TWO_LN2 * LOG2_SCALE
    return v_mean, v_absolute, (k * s[3], k * s[4], k * s[5]), s[0] * tl.exp2(-log2_opacity)


@partial(jit, do_not_specialize=["start", "end"])
def project_rows_backward(
    means, quaternions, scales, opacities, first, rest, displacements, view, records, tile_counts, sums,
    v_means, v_quaternions, v_scales, v_opacities, v_first, v_rest, v_screen, start, end,
    SUMS: tl.constexpr, TERMS: tl.constexpr, STORED: tl.constexpr, REST: tl.constexpr, ANTIALIAS: tl.constexpr,
    CLAMPED: tl.constexpr, DETACHED: tl.constexpr, PLAIN: tl.constexpr, DISTORTED: tl.constexpr,
    ROLLING: tl.constexpr, COLUMNS: tl.constexpr, DISPLACED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of the rows from ``start`` to ``end``, of one table of harmonics; exactly 0 for rows that were not
    drawn, of which only the tile count is read.

    SUMS: how many numbers a row has in ``sums``, of which the first twelve are read. REST: whether coefficients behind
    the first have gradients."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    if STORED >= 0:
        row += start
    given = row < end
    seen = given & (tl.load(tile_counts + row, given, 0) > 0)
    rotation = load_matrix(view + ROTATION)
    mean = in_camera(view, rotation, load_row(means, row, seen, 3))
    # Lanes of rows that were not drawn compute with a harmless row.
    mean = (tl.where(seen, mean[0], 0.0), tl.where(seen, mean[1], 0.0), tl.where(seen, mean[2], 1.0))
    s = load_columns(sums, row, seen, SUMS)
    coefficients = coefficients_of(first, rest, row, start, seen, TERMS, STORED)
    # This comes first, so that nothing else holds registers meanwhile.
    v_colors = (s[8], s[9], s[10])
    v_coefficients, v_mean = color_backward(rotation, mean, v_colors, coefficients, TERMS, CLAMPED, DETACHED)
    if STORED >= 0:
        store_harmonics(v_first, v_rest, row - start, v_coefficients, given, TERMS, STORED, REST)
    else:
        store_columns(v_first, row, v_coefficients, given, 3 * TERMS)

    size = load_row(scales, row, seen, 3)
    unit, inverse_length = unit_quaternion(load_columns(quaternions, row, seen, 4))
    axes = camera_axes(rotation, unit, size)
    lens = lens_shape(view, mean, axes, DISTORTED)
    shape = lens
    if ROLLING:
        moved = times(rotation, load_row(displacements, row, seen & DISPLACED, 3))
        speed = velocity(view, mean, moved, DISTORTED)
        shape, _ = roll(view, lens, speed, COLUMNS)

    to = record.record_of(records, row)
    v_screen_mean, v_absolute, v_l, v_effective = screen_gradient(s, to, seen)
    opacity = tl.load(opacities + row, seen, 0.0)
    _, _, determinant = blurred(view, shape[2], shape[3], shape[5])
    v_opacity = v_effective * compensation(shape[5], determinant, ANTIALIAS)
    v_xx, v_yy, v_xy, v_bare = conic_backward(view, shape, v_l, v_effective, opacity, ANTIALIAS)
    v_shape = (v_screen_mean[0], v_screen_mean[1], v_xx, v_yy, v_xy, v_bare)
    if ROLLING:
        v_shape, v_speed = roll_backward(view, lens, speed, v_shape, COLUMNS)
        v_mean = plus(v_mean, velocity_backward(view, mean, moved, v_speed, DISTORTED))
    through_lens, v_axes = lens_backward(view, mean, axes, v_shape, DISTORTED)
    v_quaternion, v_size = axes_backward(rotation, unit, inverse_length, size, v_axes)
    v_mean = plus(plus(v_mean, through_lens), (0.0, 0.0, s[11]))
    v_mean = transposed_times(rotation, v_mean)
    store_row(v_means, row, masked(v_mean, seen, 3), given, 3)
    store_columns(v_quaternions, row, masked(v_quaternion, seen, 4), given, 4)
    store_row(v_scales, row, masked(v_size, seen, 3), given, 3)
    store_row(v_screen, row, masked(v_screen_mean if PLAIN else v_absolute, seen, 2), given, 2)
    tl.store(v_opacities + row, tl.where(seen, v_opacity, 0.0), given)


@jit
def masked(values, mask, COUNT: tl.constexpr):
    """``values``, exactly 0 where the mask is off."""
    out = ()
    for i in tl.static_range(COUNT):
        out += (tl.where(mask, values[i], 0.0),)
    return out
