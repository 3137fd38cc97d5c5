"""Sorted pairs as lists of tiles: where each tile's pairs begin and end, in which order tiles start, and their parts.

Tiles start by the power of two of their number of pairs, longest first, because long ones must not start last. Within
such a class neighboring tiles follow each other. They share splats, which are then still in the caches. This is a
counting sort: programs of 256 tiles first count their tiles of each class, and their parts. Then each adds up what
lies before its own.
"""

from functools import partial

import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from sparsestreet.ops.triton.arena import vectors
from sparsestreet.ops.triton.blend import PIXEL_COUNT
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.parts import Parts, most_parts_of, part_begin, parts_of, shortest_split, split_rule
from sparsestreet.ops.triton.search import first_at_least
from sparsestreet.ops.triton.sizes import LISTED_PAIRS, Sizes

_BLOCK = 256
_CLASS_COUNT = 32
CLASSES = constant(_CLASS_COUNT)
LONGEST_CLASS = constant(11)
AHEAD_CLASS = constant(13)
"""A tile of 2^12 times the length from which tiles are split would have more pairs than all together.

Up to AHEAD_CLASS tiles have a quarter of that length and more, about that of a part."""
CHUNK = constant(32)
_AHEAD = 4
AHEAD = constant(_AHEAD)
"""Room for one number, which the pixel kernels read, as memory is laid out (arena.py)."""


def list_by_tile(
    keys: Int[Tensor, " p"], slots: Int[Tensor, " p"], unsorted_rows: Int[Tensor, " p"], sizes: Sizes, tiles: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Parts | None]:
    """Rows of the sorted pairs, begins and ends of the tiles, their order, and room for their parts (``Lists``).

    ``keys``: the sorted tiles of the pairs, ``slots``: which each was before the sort.

    It does not wait for the device: there is room for the most parts that this room of pairs could need."""
    room, blocks = keys.shape[0], -(-tiles // _BLOCK)
    part_count, rule = most_parts_of(room), split_rule()
    scratch = _AHEAD + 2 * tiles + 2 * _CLASS_COUNT * blocks
    pair_rows, begins, ends, whole_ends, order, of_tiles, ahead, lasts, *part_vectors = vectors(
        keys, room, *(tiles,) * 5, scratch, part_count * PIXEL_COUNT, *(part_count,) * 5
    )
    launch(
        bound_tiles, max(room, tiles), _BLOCK,
        keys, slots, unsorted_rows, pair_rows, begins, ends, whole_ends, ahead, sizes.on_device,
        tiles, blocks, room.bit_length(), *rule,
    )  # fmt: skip
    launch(
        order_tiles, max(tiles, part_count), _BLOCK,
        begins, ends, ahead, order, of_tiles, *part_vectors, tiles, blocks, part_count,
    )  # fmt: skip
    parts = Parts(*part_vectors, of_tiles, whole_ends, ahead, lasts) if part_count else None
    return pair_rows, begins, ends, order, parts


@jit
def length_class(length, whole):
    """0 for the longest tiles, and one more for each power of two that the length is shorter; the last for none.

    LONGEST_CLASS and less if and only if length >= whole."""
    power = ((length.to(tl.float32) / whole).to(tl.int32, bitcast=True) >> 23) - 127
    power = tl.where(length >= whole, tl.maximum(power, 0), tl.minimum(power, -1))
    return tl.minimum(tl.maximum(LONGEST_CLASS - power, 0), CLASSES - 1)


@jit
def counted(scratch, tiles):
    """What the first kernel hands to the second: the classes of tiles, their numbers of parts, and a table [2, CLASSES,
    blocks] of the tiles, and the parts, of each class in each program's share."""
    classes = scratch + AHEAD
    return classes, classes + tiles, classes + 2 * tiles


@partial(
    jit,
    do_not_specialize=["tiles", "blocks", "steps", "shortest_part", "most_parts", "fewest_parts"],
)
def bound_tiles(
    keys, slots, unsorted_rows, pair_rows, begins, ends, whole_ends, scratch, sizes,
    tiles, blocks, steps, shortest_part, most_parts, fewest_parts, BLOCK: tl.constexpr,
):  # fmt: skip
    """Rows of the sorted pairs; where each tile's pairs begin and end, the class of its length, and its parts.

    Each program does its share of pairs and of tiles."""
    classes, part_counts, table = counted(scratch, tiles)
    start = tl.program_id(0) * BLOCK
    pairs = tl.load(sizes + LISTED_PAIRS).to(tl.int32)
    pair = start + tl.arange(0, BLOCK)
    row = tl.load(unsorted_rows + tl.load(slots + pair, pair < pairs, 0), pair < pairs, 0)
    tl.store(pair_rows + pair, row, pair < pairs)
    if start < tiles:
        # Both searches run together, because each step of one waits for its load.
        end = tl.arange(0, 2)[:, None]
        tile = start + tl.arange(0, BLOCK)[None, :] + 0 * end
        bound = first_at_least(keys, tile + end, pairs, steps)
        begin, stop = tl.sum(tl.where(end == 0, bound, 0), 0), tl.sum(tl.where(end == 1, bound, 0), 0)
        length, least = shortest_split(pairs, shortest_part, most_parts, fewest_parts)
        tile = start + tl.arange(0, BLOCK)
        given = tile < tiles
        parts, kind = parts_of(stop - begin, length, least), length_class(stop - begin, least)
        tl.store(begins + tile, begin, given)
        tl.store(ends + tile, stop, given)
        tl.store(whole_ends + tile, tl.where(parts > 0, begin, stop), given)
        tl.store(classes + tile, kind, given)
        tl.store(part_counts + tile, parts, given)
        each = tl.arange(0, CLASSES)
        own = (kind[None, :] == each[:, None]) & given[None, :]
        at = table + each * blocks + tl.program_id(0)
        tl.store(at, tl.sum(own.to(tl.int32), 1))
        tl.store(at + CLASSES * blocks, tl.sum(tl.where(own, parts[None, :], 0), 1))


@jit
def before_block(table, block, blocks):
    """Of each class: how many of the table's things lie before this block's, in earlier classes too; and how many there
    are."""
    each, chunk = tl.arange(0, CLASSES)[:, None], tl.arange(0, CHUNK)[None, :]
    earlier, every = tl.zeros((CLASSES,), tl.int32), tl.zeros((CLASSES,), tl.int32)
    for first in range(0, blocks, CHUNK):
        other = first + chunk + 0 * each
        counts = tl.load(table + each * blocks + other, other < blocks, 0)
        every += tl.sum(counts, 1)
        earlier += tl.sum(tl.where(other < block, counts, 0), 1)
    return earlier + tl.cumsum(every, 0) - every, every


@jit
def of_class(values, kind):
    """The value of each lane's class."""
    each = tl.arange(0, CLASSES)
    return tl.sum(tl.where(kind[:, None] == each[None, :], values[None, :], 0), 1)


@partial(jit, do_not_specialize=["tiles", "blocks", "part_count"])
def order_tiles(
    begins, ends, scratch, order, of_tiles, part_tiles, part_begins, part_ends, firsts, nexts,
    tiles, blocks, part_count, BLOCK: tl.constexpr,
):  # fmt: skip
    """Tiles by class, how many of them start before the parts, and the parts; those behind the last are empty."""
    classes, part_counts, table = counted(scratch, tiles)
    block = tl.program_id(0)
    tile = block * BLOCK + tl.arange(0, BLOCK)
    given = tile < tiles
    first_of_class, tiles_of_class = before_block(table, block, blocks)
    first_parts, parts_of_class = before_block(table + CLASSES * blocks, block, blocks)
    kind, count = tl.load(classes + tile, given, 0), tl.load(part_counts + tile, given, 0)
    place, part = of_class(first_of_class, kind), of_class(first_parts, kind)
    for first in range(block * BLOCK, tl.minimum((block + 1) * BLOCK, tiles), CHUNK):
        other = first + tl.arange(0, CHUNK)
        # Of no class behind the last tile.
        same = tl.load(classes + other, other < tiles, -1)[None, :] == kind[:, None]
        same = same & (other[None, :] < tile[:, None])
        place += tl.sum(same.to(tl.int32), 1)
        part += tl.sum(tl.where(same, tl.load(part_counts + other, other < tiles, 0)[None, :], 0), 1)
    tl.store(order + place, tile, given)
    tl.store(of_tiles + tile, tl.where(count > 0, part, -1), given)
    if (part_count > 0) & (block == 0):
        tl.store(scratch, tl.sum(tl.where(tl.arange(0, CLASSES) <= AHEAD_CLASS, tiles_of_class, 0)))

    begin, end = tl.load(begins + tile, given, 0), tl.load(ends + tile, given, 0)
    for i in range(tl.max(count)):
        mine = i < count
        tl.store(part_tiles + part + i, tile, mine)
        tl.store(part_begins + part + i, part_begin(begin, end, count, i), mine)
        tl.store(part_ends + part + i, part_begin(begin, end, count, i + 1), mine)
        tl.store(firsts + part + i, part, mine)
        tl.store(nexts + part + i, part + count, mine)
    # Lanes stand for parts, of which there may be more than tiles.
    unused = (tile >= tl.sum(parts_of_class)) & (tile < part_count)
    tl.store(part_tiles + tile, 0, unused)
    tl.store(part_begins + tile, 0, unused)
    tl.store(part_ends + tile, 0, unused)
    tl.store(firsts + tile, tile, unused)
    tl.store(nexts + tile, tile, unused)
