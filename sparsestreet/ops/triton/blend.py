"""Forward: blends each tile's splats, nearest first, into its 256 pixels.

One warp per tile (or per part of a long one, parts.py) holds 8 pixels per lane in registers, two of each quadrant of
the tile (quadrants.py). It walks the splats one by one; every number of a splat is one load for all lanes. The row of
the next pair is fetched ahead. Registers and instructions are bounded in tests/ops/triton/test_machine_code.py.
"""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.programs import place_of, work_of
from sparsestreet.ops.triton.quadrants import (
    WARP,
    across,
    centers,
    held_splat,
    hold_splats,
    of_lines,
    part_places,
    quadrant_places,
    touches,
)
from sparsestreet.ops.triton.thin import LOOK, alpha_of, open_light, thin_pairs
from sparsestreet.ops.triton.view import TILE

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
    """Writes a quadrant's layers: color, light, depth, and where each pixel ended."""
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
    """Writes every pixel of one tile, and those of a part, if needed, into the layers of parts (parts.py).

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
