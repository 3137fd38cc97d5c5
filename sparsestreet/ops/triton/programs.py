"""Which tile, or which part of a long one (parts.py), a program of the pixel kernels works on.

Alone, one program takes each tile in the order of the list, or each part. Together, the longest tiles start first, then
the parts, then the short tiles: programs start in the order of their numbers, and what is long must not start last.
"""

import triton.language as tl

from sparsestreet.ops.triton.language import jit


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
