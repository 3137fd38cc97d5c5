"""Forward: blends each tile's splats, nearest first, into its 256 pixels.

One warp per tile (or per part of a long one, parts.py) holds 8 pixels per lane in registers, two of each quadrant of
the tile (quadrants.py). It walks the splats one by one; every number of a splat is one load for all lanes. The row of
the next pair is fetched ahead. Registers and instructions are bounded in tests/ops/triton/test_machine_code.py.
"""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import view as record
from sparsestreet.ops.triton.launch import constant, jit
from sparsestreet.ops.triton.view import TILE, lines_span


@jit
def place_of(ahead, part_count, TOGETHER: tl.constexpr):
    """Place of this program's tile in the order, and whether and which part it has instead.

    ``ahead[0]``: number of tiles that start before the parts. Volatile, so that the compiler computes all this anew
    after a loop instead of keeping it in registers."""
    place = tl.program_id(0)
    part = place
    is_part = place >= 0
    if TOGETHER:
        part = place - tl.load(ahead, volatile=True)
        is_part = (part >= 0) & (part < part_count)
        place = tl.where(is_part, 0, tl.where(part < 0, place, place - part_count))
        part = tl.where(is_part, part, 0)
    return place, part, is_part


@jit
def work_of(
    begins, ends, order, ahead, part_tiles, part_begins, part_ends, part_count,
    REST: tl.constexpr, TOGETHER: tl.constexpr,
):  # fmt: skip
    """Tile, number of the part, first pair, the one after the last, and whether it is a part.

    REST: parts alone; TOGETHER: whole tiles and parts; else whole tiles alone."""
    place, part, is_part = place_of(ahead, part_count, TOGETHER)
    if TOGETHER:
        tile = tl.where(is_part, tl.load(part_tiles + part), tl.load(order + place))
        begin = tl.where(is_part, tl.load(part_begins + part), tl.load(begins + tile))
        end = tl.where(is_part, tl.load(part_ends + part), tl.load(ends + tile))
    elif REST:
        tile, begin, end = tl.load(part_tiles + part), tl.load(part_begins + part), tl.load(part_ends + part)
    else:
        tile = tl.load(order + place)
        begin, end = tl.load(begins + tile), tl.load(ends + tile)
    return tile, part, begin, end, is_part


SIDE = constant(8)
QUADRANT_PIXELS = 64
QUADRANT_SIZE = constant(QUADRANT_PIXELS)
WARP = constant(32)
QUADRANT_SHIFT = 28
MAX_ROWS = 1 << QUADRANT_SHIFT
"""Most rows: a pair stores its row and its quadrants in 32 bits."""
ROW = constant(MAX_ROWS - 1)
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
    p = tl.arange(0, QUADRANT_SIZE)
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
    return tl.sum(tl.reshape(values, (QUADRANT_SIZE // WARP, WARP)), 0)


@jit
def of_lane(values):
    """Values that the two pixels of each lane share [32]."""
    return tl.max(tl.reshape(values, (QUADRANT_SIZE // WARP, WARP)), 0)


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
    return tl.reshape(tl.broadcast_to(value[None, :], (QUADRANT_SIZE // WARP, WARP)), (QUADRANT_SIZE,))


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


# Number of pairs between two checks whether the whole tile is finished.
LOOK_LENGTH = 32
LOOK = constant(LOOK_LENGTH)


@jit
def open_light(tile, width, height, tiles_x, QUADRANT: tl.constexpr):
    """Light before the first splat: none outside the image."""
    _, inside = quadrant_places(tile, width, height, tiles_x, QUADRANT)
    return tl.where(inside, 1.0, 0.0)


@jit
def alpha_of(exponent, ends, alpha_max):
    """Alpha after the clamp, times the gate where rows have gates (``load_shape``)."""
    alpha = tl.minimum(tl.exp2(exponent), alpha_max)
    return alpha * ends[2] if len(ends) > 2 else alpha


@jit
def thin_quadrant(touched, passed, x, line, RIGHT: tl.constexpr, shape, alpha_max):
    """A quadrant's light after a splat, which may touch it; rounded as in the blend."""
    if touched:
        geometry, ends = shape
        _, a = across(x, geometry, line, RIGHT)
        exponent = line[3] - a * a
        alpha = alpha_of(exponent, ends, alpha_max)
        passed -= tl.where(exponent >= ends[1], alpha, 0.0) * passed
    return passed


@jit
def thin_pairs(
    records, pair_rows, k, end, tile, part, products, width, height, tiles_x, alpha_max, transmittance_min,
    GATED: tl.constexpr,
):  # fmt: skip
    """Write the product of 1 - alpha over the pairs of a part, or some value below the limit once it is below."""
    t0, t1 = open_light(tile, width, height, tiles_x, 0), open_light(tile, width, height, tiles_x, 1)
    t2, t3 = open_light(tile, width, height, tiles_x, 2), open_light(tile, width, height, tiles_x, 3)
    x, y = centers(tile, tiles_x)
    unfinished = k < end
    pair = tl.load(pair_rows + k, unfinished, 0)
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        for i in range(k, stop):
            shape, touched = load_shape(records, row_of(pair), GATED), pair
            pair = tl.load(pair_rows + i + 1, i + 1 < end, 0)
            line = of_lines(y, shape[0], shape[1][0], 0)
            t0 = thin_quadrant(touches(touched, 0), t0, x, line, 0, shape, alpha_max)
            t1 = thin_quadrant(touches(touched, 1), t1, x, line, 1, shape, alpha_max)
            line = of_lines(y, shape[0], shape[1][0], 1)
            t2 = thin_quadrant(touches(touched, 2), t2, x, line, 0, shape, alpha_max)
            t3 = thin_quadrant(touches(touched, 3), t3, x, line, 1, shape, alpha_max)
        k = stop
        most = tl.maximum(tl.maximum(t0, t1), tl.maximum(t2, t3))
        unfinished = (k < end) & (tl.max(most) > transmittance_min)
    tl.store(products + part_places(part, 0), t0)
    tl.store(products + part_places(part, 1), t1)
    tl.store(products + part_places(part, 2), t2)
    tl.store(products + part_places(part, 3), t3)


PIXEL_COUNT = 256
PIXELS = constant(PIXEL_COUNT)


def registers(gated: bool) -> int:
    """Return the fewest registers of a lane without spills. A multiprocessor runs 20 warps with up to 96."""
    return 96 + 8 * gated


@jit
def pixels_of(tile, width, height, tiles_x):
    """Columns and lines of a tile's pixels, and which of them lie in the image; all [256].

    For kernels that take all pixels of a tile at once. With one axis, each version of the compiler gives a lane pixels
    of one line."""
    p = tl.arange(0, PIXELS)
    x = (tile % tiles_x) * TILE + (p // WARP) * (WARP // TILE) + p % WARP // TILE
    y = (tile // tiles_x) * TILE + p % TILE
    return x, y, (x < width) & (y < height)


@jit
def whitened(s, px, py):
    """d = pixel - mean along both axes, L d, and log2 of alpha before the clamp; all [256]."""
    dx, dy = px - tl.load(s + record.X), py - tl.load(s + record.Y)
    b = tl.load(s + record.L22) * dy
    a = tl.load(s + record.L11) * dx + tl.load(s + record.L21) * dy
    return dx, dy, a, b, tl.load(s + record.LOG2_OPACITY) - b * b - a * a


@jit
def blend_one(alpha, drawn, passed, transmittance_min, EXCLUSIVE: tl.constexpr):
    """Blend weight of a splat, the light that passes it, and which pixels were open to it, drawn there or not.

    A pixel is finished for good when ``passed`` is at most ``transmittance_min``. The exclusive stop drops the splat
    that would cross that limit, and marks the pixel by the sign, because the light itself stays above.
    """
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
def open_quadrant(tile, part, first, products, first_pair, width, height, tiles_x, QUADRANT: tl.constexpr):
    """A quadrant before its first splat: light, color, depth, and the index after the last pair each pixel was open to.

    Light is what the parts of the tile from ``first`` on let through, 0 for pixels outside the image."""
    passed = open_light(tile, width, height, tiles_x, QUADRANT)
    for before in range(first, part):
        passed *= tl.load(products + part_places(before, QUADRANT))
    nothing = tl.zeros_like(passed)
    return passed, nothing, nothing, nothing, nothing, nothing.to(tl.int32) + first_pair


@jit
def blend_quadrant(
    touched, quadrant, x, line, RIGHT: tl.constexpr, splat, k, alpha_max, transmittance_min,
    EXCLUSIVE: tl.constexpr, DEPTH: tl.constexpr, LASTS: tl.constexpr,
):  # fmt: skip
    """A quadrant after a splat, which may touch it."""
    passed, red, green, blue, depth, last = quadrant
    if touched:
        geometry, ends, light = splat
        _, a = across(x, geometry, line, RIGHT)
        exponent = line[3] - a * a
        alpha = alpha_of(exponent, ends, alpha_max)
        weight, passed, still = blend_one(alpha, exponent >= ends[1], passed, transmittance_min, EXCLUSIVE)
        red += weight * light[0]
        green += weight * light[1]
        blue += weight * light[2]
        if DEPTH:
            depth += weight * light[3]
        if LASTS:
            last = tl.where(still, k + 1, last)
    return passed, red, green, blue, depth, last


@jit
def any_open(upper_left, upper_right, lower_left, lower_right, transmittance_min):
    """Whether a pixel of the tile still takes light."""
    upper, lower = tl.maximum(upper_left[0], upper_right[0]), tl.maximum(lower_left[0], lower_right[0])
    return tl.max(tl.maximum(upper, lower)) > transmittance_min


@jit
def store_quadrant(quadrant, at, inside, layers, DEPTH: tl.constexpr, LASTS: tl.constexpr):
    """Write a quadrant's layers: color, light, depth, and where each pixel ended."""
    passed, red, green, blue, depth, last = quadrant
    rgb, transmittance, depth_sum, lasts = layers
    tl.store(rgb + 3 * at, red, inside)
    tl.store(rgb + 3 * at + 1, green, inside)
    tl.store(rgb + 3 * at + 2, blue, inside)
    tl.store(transmittance + at, tl.abs(passed), inside)
    if DEPTH:
        tl.store(depth_sum + at, depth, inside)
    if LASTS:
        tl.store(lasts + at, last, inside)


@jit
def store_in_image(
    wanted, quadrants, layers, order, place, width, height, tiles_x, DEPTH: tl.constexpr, LASTS: tl.constexpr
):
    if wanted:
        # Volatile, so that the compiler computes indices anew instead of keeping them in registers through the loop.
        tile = tl.load(order + place, volatile=True)
        for i in tl.static_range(4):
            at, inside = quadrant_places(tile, width, height, tiles_x, i)
            store_quadrant(quadrants[i], at, inside, layers, DEPTH, LASTS)


@jit
def store_in_part(
    wanted, quadrants, layers, part, products, DEPTH: tl.constexpr, LASTS: tl.constexpr, PRODUCTS: tl.constexpr
):
    """PRODUCTS: also what a first part lets through. That is 0 for a pixel that the exclusive stop has closed."""
    if wanted:
        for i in tl.static_range(4):
            at = part_places(part, i)
            store_quadrant(quadrants[i], at, at >= 0, layers, DEPTH, LASTS)
            if PRODUCTS:
                tl.store(products + at, tl.maximum(quadrants[i][0], 0.0))


# Specialized to the sizes of some images, the kernel would need one register too many.
@partial(jit, do_not_specialize=["width", "height", "tiles_x", "part_count"])
def blend_tiles(
    records, pair_rows, begins, ends, order, ahead, part_tiles, part_begins, part_ends, firsts, nexts, products,
    rgb, transmittance, depth_sum, lasts, part_rgb, part_transmittance, part_depth, part_lasts,
    width, height, tiles_x, part_count, alpha_max, transmittance_min,
    EXCLUSIVE: tl.constexpr, DEPTH: tl.constexpr, LASTS: tl.constexpr,
    TOGETHER: tl.constexpr, REST: tl.constexpr, GATED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write every pixel of one tile, and those of a part, if needed, into the layers of parts (parts.py).

    ``lasts`` (if LASTS): the index after the last pair that a pixel took light from, where backward begins. TOGETHER:
    whole tiles and parts. Of parts the first ones of tiles are then blended, and of the others it is computed what they
    let through. REST: parts but the first ones. GATED: a row's gate multiplies its alpha. Each lane fetches the record
    of one of the next pairs, because a warp then waits for memory once in LOOK pairs.
    """
    tl.static_assert(BLOCK == 1)
    tables = (begins, ends, order, ahead, part_tiles, part_begins, part_ends, part_count)
    tile, part, k, end, is_part = work_of(*tables, REST, TOGETHER)
    limit, first = transmittance_min, part
    if REST or TOGETHER:
        first = tl.load(firsts + part)
    if TOGETHER:
        later = is_part & (first < part)
        if later & (part + 1 < tl.load(nexts + part)):
            thin_pairs(
                records, pair_rows, k, end, tile, part, products, width, height, tiles_x, alpha_max, limit,
                GATED,
            )  # fmt: skip
        first, end = part, tl.where(later, k, end)
    if REST:
        end = tl.where(first < part, end, k)
    q0 = open_quadrant(tile, part, first, products, k, width, height, tiles_x, 0)
    q1 = open_quadrant(tile, part, first, products, k, width, height, tiles_x, 1)
    q2 = open_quadrant(tile, part, first, products, k, width, height, tiles_x, 2)
    q3 = open_quadrant(tile, part, first, products, k, width, height, tiles_x, 3)
    x, y = centers(tile, tiles_x)
    written = k < end
    unfinished = written & any_open(q0, q1, q2, q3, limit)
    pair = tl.load(pair_rows + k, written, 0)
    while unfinished:
        stop = tl.minimum(k + LOOK, end)
        held = hold_splats(records, pair_rows, k, end, GATED)
        for i in range(k, stop):
            touched = pair
            splat = held_splat(held, i - k, GATED)
            pair = tl.load(pair_rows + i + 1, i + 1 < end, 0)
            more = (splat, i, alpha_max, limit, EXCLUSIVE, DEPTH, LASTS)
            line = of_lines(y, splat[0], splat[1][0], 0)
            q0 = blend_quadrant(touches(touched, 0), q0, x, line, 0, *more)
            q1 = blend_quadrant(touches(touched, 1), q1, x, line, 1, *more)
            line = of_lines(y, splat[0], splat[1][0], 1)
            q2 = blend_quadrant(touches(touched, 2), q2, x, line, 0, *more)
            q3 = blend_quadrant(touches(touched, 3), q3, x, line, 1, *more)
        k = stop
        unfinished = (k < end) & any_open(q0, q1, q2, q3, limit)
    quadrants = (q0, q1, q2, q3)
    place, part, is_part = place_of(ahead, part_count, TOGETHER)
    if REST or TOGETHER:
        layers = (part_rgb, part_transmittance, part_depth, part_lasts)
        store_in_part(written & is_part, quadrants, layers, part, products, DEPTH, LASTS, TOGETHER)
    if not REST:
        layers, is_whole = (rgb, transmittance, depth_sum, lasts), place >= 0
        if TOGETHER:
            is_whole = not is_part
        store_in_image(is_whole, quadrants, layers, order, place, width, height, tiles_x, DEPTH, LASTS)
