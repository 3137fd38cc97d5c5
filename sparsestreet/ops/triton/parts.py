"""Long tiles in parts, so that a few deep tiles do not keep the device waiting for one warp each.

A part starts with the light that the parts before it let through. First it is computed for all parts at once what each
lets through alone: a first part is blended for that, behind a last one nothing lies. Then the other parts are blended
from their true start, with the stop rule of the whole tile, and ``merged`` adds up the parts. The image differs
from that of an unsplit tile only by rounding. In backward the light behind a part is the sum of the parts behind it.

A tile is split only if it is longer than the share of all pairs of a warp that a large GPU runs. The
transmittance of parts in the middle is computed twice, which pays only if other warps would wait.
"""

from dataclasses import dataclass

import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from sparsestreet.ops.triton.arena import vectors
from sparsestreet.ops.triton.blend import PIXEL_COUNT, PIXELS
from sparsestreet.ops.triton.language import jit

MAX_PARTS = 6144
"""Most parts of a view, 7 kB each. A part has at least one of so many shares of all pairs; 1: no tile is split.

A street lasts as long as its longest tile: without a split the pixel kernels of one took 3 to 5 times as long. The
split moves images by rounding, as the light before a part is a product of other parts' products."""
MIN_PART_PAIRS = 128
"""Least number of pairs of a part. It bounds what parts cost in small views."""
MIN_PARTS = 3
"""Parts of the shortest tile that is split. What a split costs is too much for two parts."""


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


def part_length(pairs: int) -> int:
    """Least number of pairs of a part, for a view with ``pairs``; parts of a tile differ by at most one."""
    return max(MIN_PART_PAIRS, -(-pairs // MAX_PARTS))


def split_length(pairs: int) -> int:
    """Least number of pairs of a tile that is split, for a view with ``pairs``.

    Views of 2,400 tiles (960x640) or more of similar length have no split tile. A part does not know which of its
    pixels earlier parts have closed, so in an opaque tile it computes hidden splats once in vain.
    """
    return MIN_PARTS * part_length(pairs)


def most_parts_of(room: int) -> int:
    """Most parts that up to ``room`` pairs of a view can need; 0 if no tile can be long enough for some."""
    most = min(MAX_PARTS, room // MIN_PART_PAIRS)
    # In fours, as memory is laid out (arena.py).
    return -(-most // 4) * 4 if most >= MIN_PARTS else 0


def split_rule() -> tuple[int, int, int]:
    """Return least pairs of a part, most parts of a view, and fewest parts of a tile that is split."""
    return MIN_PART_PAIRS, MAX_PARTS, MIN_PARTS


@jit
def shortest_split(pairs, shortest_part, most_parts, fewest_parts):
    """As ``part_length`` and ``split_length``: of a part, and of a tile that is split."""
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
