"""Long tiles in parts, so that a few deep tiles do not keep the device waiting for one warp each.

A part starts with the light that the parts before it let through. First it is computed for all parts at once what each
lets through alone: a first part is blended for that, behind a last one nothing lies. Then the other parts are blended
from their true start, with the stop rule of the whole tile, and ``merge_parts`` adds up the parts. The image differs
from that of an unsplit tile only by rounding. In backward the light behind a part is the sum of the parts behind it.

A tile is split only if it is longer than the share of all pairs of a warp that a large GPU runs. The
transmittance of parts in the middle is computed twice, which pays only if other warps would wait.
"""

from dataclasses import dataclass
from functools import partial

import torch
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton.blend import PIXEL_COUNT, PIXELS, part_pixels, pixels_of
from sparsestreet.ops.triton.language import jit
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.search import first_at_least
from sparsestreet.ops.triton.thin import thin_pairs
from sparsestreet.ops.triton.tuning import tuning

_BLOCK = 128


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
    whole_ends: Int[Tensor, " t"]
    """End of each tile's pairs; their beginning where the tile is split."""
    ahead: Int[Tensor, " 1"]
    """Number of tiles that are at least about as long as a part, and start before the parts."""

    def __len__(self) -> int:
        return len(self.tiles)


@dataclass(frozen=True)
class PartLayers:
    """What each part adds to its tile's pixels (as in ``Raster``), and the light after it."""

    products: Float[Tensor, "s 256"]
    """Light that the part alone lets through; unwritten for the last part of a tile."""
    rgb: Float[Tensor, "s 256 3"]
    transmittance: Float[Tensor, "s 256"]
    depth_sum: Float[Tensor, "s 256"]
    lasts: Int[Tensor, "s 256"]
    """Index after the last pair of the part that each pixel was open to."""

    @staticmethod
    def empty(parts: Parts, like: Tensor) -> "PartLayers":
        """Unwritten layers on the device of ``like``."""
        count = len(parts)
        pixels = [like.new_empty(count, PIXEL_COUNT) for _ in range(3)]
        rgb, lasts = like.new_empty(count, PIXEL_COUNT, 3), parts.tiles.new_empty(count, PIXEL_COUNT)
        return PartLayers(pixels[0], rgb, pixels[1], pixels[2], lasts)


def part_length(pairs: int) -> int:
    """Least number of pairs of a part, for a view with ``pairs``; parts of a tile differ by at most one."""
    return max(tuning().shortest_part, -(-pairs // tuning().most_parts))


def split_length(pairs: int) -> int:
    """Least number of pairs of a tile that is split, for a view with ``pairs``.

    Views of 2,400 tiles (960x640) or more of similar length have no split tile. A part does not know which of its
    pixels earlier parts have closed, so in an opaque tile it computes hidden splats once in vain.
    """
    return tuning().fewest_parts * part_length(pairs)


def split_tiles(
    begins: Int[Tensor, " t"], ends: Int[Tensor, " t"], order: Int[Tensor, " t"], lengths: Int[Tensor, " t"], pairs: int
) -> Parts | None:
    """Parts of all tiles of ``split_length`` and more; None if there are too few pairs for one.

    ``order`` holds the tiles, split ones first, and ``lengths`` the number of pairs of each tile. It does not wait for
    the device, but makes room for the most parts that this number of pairs could need.
    """
    length, least = part_length(pairs), split_length(pairs)
    if pairs < least:
        return None
    # No more tiles can be that long. Shorter ones come last, so they do not shift the parts of others.
    most, split = pairs // length, pairs // least
    nexts = (lengths.index_select(0, order[:split]) // length).cumsum(0, dtype=torch.int32)
    parts = Parts(*(begins.new_empty(most) for _ in range(5)), torch.empty_like(ends), begins.new_empty(1))
    launch(
        list_parts, max(most, len(order)), _BLOCK,
        begins, ends, order, lengths, nexts,
        parts.tiles, parts.begins, parts.ends, parts.firsts, parts.nexts, parts.whole_ends, parts.ahead,
        len(order), len(nexts), len(nexts).bit_length(), most, length, least,
    )  # fmt: skip
    return parts


@partial(jit, do_not_specialize=["tile_count", "split_count", "steps", "part_count", "length", "least"])
def list_parts(
    begins, ends, order, lengths, split_nexts, tiles, part_begins, part_ends, firsts, nexts, whole_ends, ahead,
    tile_count, split_count, steps, part_count, length, least, BLOCK: tl.constexpr,
):  # fmt: skip
    """One lane per part and per tile. ``split_nexts``: the part after the last of each of the first tiles in order."""
    number = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = number < tile_count
    tile = tl.load(order + number, given, 0)
    begin, end = tl.load(begins + tile, given, 0), tl.load(ends + tile, given, 0)
    tl.store(whole_ends + tile, tl.where(end - begin < least, end, begin), given)

    following = tl.load(lengths + tl.load(order + number + 1, number + 1 < tile_count, 0), number + 1 < tile_count, 0)
    is_long = given & (4 * (end - begin) >= least)
    tl.store(ahead + 0 * number, number + 1, is_long & (4 * following < least))
    tl.store(ahead + 0 * number, 0, (number == 0) & (4 * (end - begin) < least))

    # The first tile whose parts end after this one.
    rank = first_at_least(split_nexts, number + 1, split_count, steps)
    tile = tl.load(order + rank, rank < split_count, 0)
    pairs = tl.load(lengths + tile, rank < split_count, 0)
    used = pairs >= least
    tile, pairs, count = tl.where(used, tile, 0), tl.where(used, pairs, 0), tl.where(used, pairs // length, 1)
    next_part = tl.where(used, tl.load(split_nexts + rank, used, 0), number)
    first = tl.where(used, next_part - count, number)
    share, longer, place = pairs // count, pairs % count, number - first
    begin = tl.load(begins + tile, used, 0) + place * share + tl.minimum(place, longer)
    given = number < part_count
    tl.store(tiles + number, tile, given)
    tl.store(part_begins + number, begin, given)
    tl.store(part_ends + number, begin + share + (place < longer), given)
    tl.store(firsts + number, first, given)
    tl.store(nexts + number, next_part, given)


@jit
def thin_parts(
    records, pair_rows, tiles, begins, ends, nexts, products, width, height, tiles_x, alpha_max, transmittance_min,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes what each part lets through alone, but for the last parts of tiles, behind which nothing is blended."""
    tl.static_assert(BLOCK == 1)
    part = tl.program_id(0)
    if part + 1 < tl.load(nexts + part):
        thin_pairs(
            records, pair_rows, tl.load(begins + part), tl.load(ends + part), tl.load(tiles + part), part, products,
            width, height, tiles_x, alpha_max, transmittance_min,
        )  # fmt: skip


@jit
def merge_parts(
    tiles, firsts, nexts, products, part_rgb, part_transmittance, part_depth, part_lasts,
    rgb, transmittance, depth_sum, lasts, width, height, tiles_x, transmittance_min,
    LASTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the pixels of each split tile. There is one program per part; only that of a tile's first part works."""
    tl.static_assert(BLOCK == 1)
    part = tl.program_id(0)
    x, y, inside = pixels_of(tl.load(tiles + part), width, height, tiles_x)
    end = tl.where(tl.load(firsts + part) == part, tl.load(nexts + part), part)
    passed, rest = tl.full((PIXELS,), 1.0, tl.float32), tl.full((PIXELS,), 1.0, tl.float32)
    red, green, blue = tl.zeros_like(passed), tl.zeros_like(passed), tl.zeros_like(passed)
    depth, last = tl.zeros_like(passed), tl.zeros_like(passed).to(tl.int32)
    for i in range(part, end):
        at = part_pixels(i)
        red += tl.load(part_rgb + 3 * at)
        green += tl.load(part_rgb + 3 * at + 1)
        blue += tl.load(part_rgb + 3 * at + 2)
        depth += tl.load(part_depth + at)
        # Parts that begin after a pixel's end do not contribute to it.
        reached = passed > transmittance_min
        rest = tl.where(reached, tl.load(part_transmittance + at), rest)
        if LASTS:
            last = tl.where(reached, tl.load(part_lasts + at), last)
        passed *= tl.load(products + at, i + 1 < end, 0.0)
    at = y * width + x
    written = inside & (end > part)
    tl.store(rgb + 3 * at, red, written)
    tl.store(rgb + 3 * at + 1, green, written)
    tl.store(rgb + 3 * at + 2, blue, written)
    tl.store(transmittance + at, rest, written)
    tl.store(depth_sum + at, depth, written)
    if LASTS:
        tl.store(lasts + at, last, written)
