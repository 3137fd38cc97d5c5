"""The light that a part of a long tile lets through: the loop of the blend (blend.py) without its colors."""

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.quadrants import (
    across,
    centers,
    load_shape,
    of_lines,
    part_places,
    quadrant_places,
    row_of,
    touches,
)

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
    """Writes the product of 1 - alpha over the pairs of a part, or some value below the limit once it is below."""
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
