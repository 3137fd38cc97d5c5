"""Long tiles in parts, so that a few deep tiles do not keep the device waiting for one warp each.

A part starts with the light that the parts before it let through. First it is computed for all parts at once what each
lets through alone: a first part is blended for that, behind a last one nothing lies. Then the other parts are blended
from their true start, with the stop rule of the whole tile, and ``merged`` adds up the parts. The image differs
from that of an unsplit tile only by rounding. In backward the light behind a part is the sum of the parts behind it.

A tile is split only if it is longer than the share of all pairs of a warp that a large GPU runs. The
transmittance of parts in the middle is computed twice, which pays only if other warps would wait.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton.blend import PIXEL_COUNT, PIXELS
from sparsestreet.ops.triton.launch import constant, jit, launch, vectors


@jit
def first_at_least(values, least, count, steps):
    """Index of the first of ``count`` sorted numbers that is not below ``least``; count < 2^steps."""
    low = tl.zeros_like(least)
    high = low + count
    for _ in range(steps):
        middle = (low + high) // 2
        below = (low < high) & (tl.load(values + middle, low < high, 0) < least)
        low, high = tl.where(below, middle + 1, low), tl.where(below, high, middle)
    return low


# Places in the numbers on the device: all pairs, visible rows and bad rows, as the host reads them. Then the pairs and
# rows that are listed, which are none if they do not fit their room.
COUNTED = 3
LISTED_PAIRS, LISTED_ROWS = constant(3), constant(4)
LENGTH = 5


class Room(NamedTuple):
    """Most visible rows and pairs that lists can hold."""

    rows: int
    pairs: int

    def holds(self, pairs: int, rows: int) -> bool:
        return pairs <= self.pairs and rows <= self.rows


@dataclass
class Sizes:
    """Numbers of one view; on the host -1 until it has waited for them."""

    on_device: Int[Tensor, "5"]
    pairs: int = -1
    rows: int = -1
    """Visible ones."""


@jit
def store_sizes(sizes, pairs, rows, bad, fits):
    """Write the numbers; all 64 bits wide, because pairs are counted before they are known to be few enough."""
    tl.store(sizes, pairs)
    tl.store(sizes + 1, rows)
    tl.store(sizes + 2, bad)
    tl.store(sizes + LISTED_PAIRS, tl.where(fits, pairs, 0))
    tl.store(sizes + LISTED_ROWS, tl.where(fits, rows, 0))


MAX_PARTS = 6144
"""Most parts of a view, 7 kB each. A part has at least one of so many shares of all pairs; 1: no tile is split.

A street lasts as long as its longest tile: without a split the pixel kernels of one took 3 to 5 times as long. The
split moves images by rounding, as the light before a part is a product of other parts' products."""
MIN_PART_PAIRS = 128
"""Least number of pairs of a part. It bounds what parts cost in small views."""
MIN_PARTS = 3
"""Parts of the shortest tile that is split. What a split costs is too much for two parts.

Views of 2,400 tiles (960x640) or more of similar length have no split tile. A part does not know which of its pixels
earlier parts have closed, so in an opaque tile it computes hidden splats once in vain."""


@dataclass(frozen=True)
class Parts:
    """The tile and the pairs of each part. Those after the last needed one are empty, of no tile, and never read."""

    tiles: Int[Tensor, " s"]
    begins: Int[Tensor, " s"]
    ends: Int[Tensor, " s"]
    firsts: Int[Tensor, " s"]
    """First part of the same tile."""
    nexts: Int[Tensor, " s"]
    """The part after the last one of the same tile."""
    of_tiles: Int[Tensor, " t"]
    """First part of each tile; -1 where it is not split."""
    whole_ends: Int[Tensor, " t"]
    """End of each tile's pairs; their beginning where the tile is split."""
    ahead: Int[Tensor, " a"]
    """First: the number of tiles that are at least about as long as a part, and start before the parts."""
    lasts: Int[Tensor, " p"]
    """Room for those of ``PartLayers``."""

    def __len__(self) -> int:
        return self.tiles.shape[0]


@dataclass(frozen=True)
class PartLayers:
    """What each part adds to its tile's pixels (as in ``Raster``), and the light after it: p = 256 s pixels, one part
    after the other, c = 3 p."""

    products: Float[Tensor, " p"]
    """Light that the part alone lets through; unwritten for the last part of a tile."""
    rgb: Float[Tensor, " c"]
    transmittance: Float[Tensor, " p"]
    depth_sum: Float[Tensor, " p"]
    lasts: Int[Tensor, " p"]
    """Index after the last pair of the part that each pixel was open to."""

    @staticmethod
    def empty(parts: Parts, like: Tensor) -> "PartLayers":
        """Unwritten layers on the device of ``like``."""
        count = len(parts) * PIXEL_COUNT
        products, rgb, transmittance, depth_sum = vectors(like, count, 3 * count, count, count, dtype=like.dtype)
        return PartLayers(products, rgb, transmittance, depth_sum, parts.lasts)


def most_parts_of(room: int) -> int:
    """Most parts that up to ``room`` pairs of a view can need; 0 if no tile can be long enough for some."""
    most = min(MAX_PARTS, room // MIN_PART_PAIRS)
    # In fours, as memory is laid out (arena.py).
    return -(-most // 4) * 4 if most >= MIN_PARTS else 0


@jit
def shortest_split(pairs, shortest_part, most_parts, fewest_parts):
    """Least number of pairs of a part, and of a tile that is split; parts of a tile differ by at most one."""
    length = tl.maximum(shortest_part, tl.cdiv(pairs, most_parts))
    return length, fewest_parts * length


@jit
def parts_of(pairs, length, least):
    """Number of parts of a tile of ``pairs``; 0: it is not split."""
    return tl.where(pairs >= least, pairs // length, 0)


@jit
def part_begin(begin, end, count, i):
    """Where the i-th of a tile's ``count`` parts begins; they differ by one pair at most."""
    pairs, count = end - begin, tl.maximum(count, 1)
    return begin + i * (pairs // count) + tl.minimum(i, pairs % count)


@jit
def merged(
    first, at, pixel, nexts, products, part_rgb, part_transmittance, part_depth, part_lasts, limit,
    LASTS: tl.constexpr,
):  # fmt: skip
    """Pixels of a tile that is split into the parts from ``first`` on; those of others (-1) as they are.

    ``at``: places of the pixels in a part, ``pixel``: light, three colors, sum of depths, and the index after the last
    pair it was open to. Nothing of a pixel of a split tile comes from the image."""
    rest, red, green, blue, depth, last = pixel
    passed = tl.full(rest.shape, 1.0, tl.float32)
    following = tl.load(nexts + first, first >= 0, 0)
    for part in range(tl.maximum(first, 0), following):
        to = part * PIXELS + at
        red += tl.load(part_rgb + 3 * to)
        green += tl.load(part_rgb + 3 * to + 1)
        blue += tl.load(part_rgb + 3 * to + 2)
        depth += tl.load(part_depth + to)
        # Parts that begin after a pixel's end do not contribute to it.
        reached = passed > limit
        rest = tl.where(reached, tl.load(part_transmittance + to), rest)
        if LASTS:
            last = tl.where(reached, tl.load(part_lasts + to), last)
        passed *= tl.load(products + to, part + 1 < following, 0.0)
    return rest, red, green, blue, depth, last


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
    part_count = most_parts_of(room)
    scratch = _AHEAD + 2 * tiles + 2 * _CLASS_COUNT * blocks
    pair_rows, begins, ends, whole_ends, order, of_tiles, ahead, lasts, *part_vectors = vectors(
        keys, room, *(tiles,) * 5, scratch, part_count * PIXEL_COUNT, *(part_count,) * 5
    )
    launch(
        bound_tiles, max(room, tiles), _BLOCK,
        keys, slots, unsorted_rows, pair_rows, begins, ends, whole_ends, ahead, sizes.on_device,
        tiles, blocks, room.bit_length(), MIN_PART_PAIRS, MAX_PARTS, MIN_PARTS,
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
