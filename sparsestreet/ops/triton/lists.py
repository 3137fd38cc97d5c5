"""Visible rows by depth, and the tiles' lists of splats in that order.

Rows are sorted by depth first, then pairs stably by their tile's short key. This takes a fraction of the traffic of
sorting long keys. A pair keeps its number from before the second sort, so the pairs of a row have neighboring numbers.
These are the slots from which the row's gradient is summed.
"""

from dataclasses import dataclass
from functools import partial

import torch
import triton.language as tl
from jaxtyping import Int
from torch import Tensor

from sparsestreet.ops.raster import PairLimitError
from sparsestreet.ops.triton import records as record
from sparsestreet.ops.triton.language import constant, jit
from sparsestreet.ops.triton.launch import launch
from sparsestreet.ops.triton.parts import Parts, split_length, split_tiles
from sparsestreet.ops.triton.quadrants import MOST_ROWS, QUADRANT_SHIFT, WARP, half_spans, touched_quadrants
from sparsestreet.ops.triton.search import first_at_least
from sparsestreet.ops.triton.tiles import tile_columns, tile_rows
from sparsestreet.ops.triton.view import KernelView

PAIR_LIMIT = 1 << 28
"""Most (splat, tile) pairs of one rendering. A pair takes 34 bytes while sorting (torch 2.11, H100; 40 above 32,768
tiles). 12 of them are kept for the backward pass, which takes 48 more: 9 and 16 GB at the limit."""
_SHORT_KEYS = 1 << 15
_BLOCK = 256
_LANES = 2
"""Lanes per splat in the listing of pairs, because most splats reach one or two rows of tiles."""
GIANT = constant(32)
"""Splats that cover at least this many tiles get a warp each."""


@dataclass(frozen=True)
class Lists:
    """The tiles' lists of splats: v visible rows, p (splat, tile) pairs, t tiles."""

    rows: Int[Tensor, " v"]
    """Visible rows, nearest first."""
    first_pairs: Int[Tensor, " v"]
    tile_counts: Int[Tensor, " v"]
    pair_rows: Int[Tensor, " p"]
    """Row of each pair, tile by tile, nearest first, with the quadrants of the tile that it touches (quadrants.py)."""
    slots: Int[Tensor, " p"]
    """Number of each of those pairs before the sort by tile."""
    begins: Int[Tensor, " t"]
    ends: Int[Tensor, " t"]
    order: Int[Tensor, " t"]
    """Tiles by the power of two of their number of pairs, longest first, because long ones must not start last."""
    parts: Parts | None
    """Room for the parts of long tiles, empty if there are none; None if no tile can be long."""

    @property
    def rows_of_pairs(self) -> Int[Tensor, " p"]:
        """``pair_rows`` without the quadrants."""
        return self.pair_rows & (MOST_ROWS - 1)

    @property
    def quadrants_of_pairs(self) -> Int[Tensor, " p"]:
        """A bit for each quadrant of the tile."""
        return self.pair_rows >> QUADRANT_SHIFT & 15


@partial(jit, do_not_specialize=["row_count"])
def list_visible(records, tile_counts, places, keys, rows, row_count, KEY_MASK: tl.constexpr, BLOCK: tl.constexpr):
    """Rows with tiles, and the sorted bits of their depths, in row order; ``places`` counts from 1."""
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = row < row_count
    seen = given & (tl.load(tile_counts + row, given, 0) > 0)
    place = tl.load(places + row, seen, 1) - 1
    # The bits of positive floats have the order of the floats.
    depth = tl.load(record.record_of(records, row) + record.DEPTH, seen, 1.0)
    tl.store(keys + place, depth.to(tl.int32, bitcast=True) & KEY_MASK, seen)
    tl.store(rows + place, row, seen)


@partial(jit, do_not_specialize=["visible"])
def list_counts(tile_counts, unsorted_rows, order, rows, counts, first_pairs, visible, BLOCK: tl.constexpr):
    """Rows in the ``order`` of their depths, and the number of pairs of each; sets ``first_pairs[0]`` to 0."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = rank < visible
    row = tl.load(unsorted_rows + tl.load(order + rank, given, 0), given, 0)
    tl.store(rows + rank, row, given)
    tl.store(counts + rank, tl.load(tile_counts + row, given, 0), given)
    tl.store(first_pairs + rank, 0, rank == 0)


@jit
def list_splats(
    records, rows, first_pairs, keys, pair_rows, rank, given, lane, width, height, tiles_x,
    BOUNDED: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """The pairs of one splat in each row of ``rank`` [splats, LANES]; each lane takes a row of tiles at a time."""
    row, at = tl.load(rows + rank, given, 0), tl.load(first_pairs + rank, given, 0)
    s = record.record_of(records, row)
    x, y = tl.load(s + record.X, given, 0.0), tl.load(s + record.Y, given, 0.0)
    l11, l21 = tl.load(s + record.L11, given, 1.0), tl.load(s + record.L21, given, 0.0)
    l22 = tl.load(s + record.L22, given, 1.0)
    reach = tl.load(s + record.LOG2_OPACITY, given, 0.0) - tl.load(s + record.CUTOFF, given, 0.0)
    reach = tl.maximum(reach, 0.0)
    first, last = tile_rows(y, l22, reach, height, BOUNDED)
    last = tl.where(given, last, first - 1)
    for i in range(0, tl.max(last - first + 1), LANES):
        line = first + i + lane
        left, right = tile_columns(x, y, l11, l21, l22, reach, line, width, BOUNDED)
        count = tl.where(line <= last, right - left + 1, 0)
        spans = half_spans((x, y, l11, l21, l22), reach, line, BOUNDED)
        begin = at + tl.cumsum(count, 1) - count
        for j in range(tl.max(count)):
            tl.store(keys + begin + j, line * tiles_x + left + j, j < count)
            tl.store(pair_rows + begin + j, row | touched_quadrants(spans, left + j, BOUNDED), j < count)
        at += tl.sum(count, 1)[:, None]


@partial(jit, do_not_specialize=["visible"])
def list_pairs(
    records, rows, counts, first_pairs, keys, pair_rows, visible, width, height, tiles_x,
    BOUNDED: tl.constexpr, LANES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes the tile of each pair, and its row with the quadrants it touches (quadrants.py).

    Pair i of a row lies in the i-th tile of its splat, counted along rows of tiles. Giants get a warp each, so that no
    other splat waits for them."""
    lane = tl.arange(0, LANES)[None, :]
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)[:, None] + 0 * lane
    count = tl.load(counts + rank, rank < visible, 0)
    list_splats(
        records, rows, first_pairs, keys, pair_rows, rank, (count > 0) & (count < GIANT), lane, width, height, tiles_x,
        BOUNDED, LANES,
    )  # fmt: skip
    if tl.max(count) >= GIANT:
        all_lanes = tl.arange(0, WARP)[None, :]
        for i in range(BLOCK):
            one = tl.program_id(0) * BLOCK + i + 0 * all_lanes
            giant = tl.load(counts + one, one < visible, 0) >= GIANT
            list_splats(
                records, rows, first_pairs, keys, pair_rows, one, giant, all_lanes, width, height, tiles_x,
                BOUNDED, WARP,
            )  # fmt: skip


@jit
def length_class(length, whole):
    """Powers of two in length / whole, rounded down; 0 and more if and only if length >= whole."""
    power = ((length.to(tl.float32) / whole).to(tl.int32, bitcast=True) >> 23) - 127
    return tl.where(length >= whole, tl.maximum(power, 0), tl.minimum(power, -1))


@partial(jit, do_not_specialize=["pairs", "tiles", "steps", "whole"])
def bound_tiles(
    keys, slots, unsorted_rows, pair_rows, begins, ends, lengths, classes, pairs, tiles, steps, whole,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Rows of the sorted pairs; where each tile's pairs begin and end, and the class of its length.

    Each program does its share of pairs and of tiles."""
    start = tl.program_id(0) * BLOCK
    pair = start + tl.arange(0, BLOCK)
    row = tl.load(unsorted_rows + tl.load(slots + pair, pair < pairs, 0), pair < pairs, 0)
    tl.store(pair_rows + pair, row, pair < pairs)
    if start < tiles:
        # Both searches run together, because each step of one waits for its load.
        end = tl.arange(0, 2)[:, None]
        tile = start + tl.arange(0, BLOCK)[None, :] + 0 * end
        bound = first_at_least(keys, tile + end, pairs, steps)
        given = tile < tiles
        tl.store(begins + tile, bound, given & (end == 0))
        tl.store(ends + tile, bound, given & (end == 1))
        tile = start + tl.arange(0, BLOCK)
        length = tl.sum(tl.where(end == 1, bound, -bound), 0)
        tl.store(lengths + tile, length, tile < tiles)
        tl.store(classes + tile, length_class(length, whole), tile < tiles)


def list_tiles(
    records: Tensor, tile_counts: Tensor, places: Tensor, visible: int, pairs: int, view: KernelView
) -> Lists:
    """Sorts rows and pairs; ``visible`` and ``pairs`` are the numbers of both, already checked.

    The device has nothing else to do, so every host call between two of our kernels is a gap.
    """
    rows, counts, first_pairs = _rows_by_depth(records, tile_counts, places, visible, view)
    columns, lines = view.tiles
    keys = tile_counts.new_empty(pairs, dtype=torch.int16 if columns * lines <= _SHORT_KEYS else torch.int32)
    unsorted_rows = tile_counts.new_empty(pairs)
    launch(
        list_pairs, visible, 32 // _LANES,
        records, rows, counts, first_pairs, keys, unsorted_rows, visible,
        float(view.camera.width), float(view.camera.height), columns,
        BOUNDED=view.bounded, LANES=_LANES, options={"enable_fp_fusion": False, "num_warps": 1},
    )  # fmt: skip
    keys, slots = torch.sort(keys, stable=True)
    pair_rows = torch.empty_like(unsorted_rows)
    begins, ends, lengths, classes = (tile_counts.new_empty(columns * lines) for _ in range(4))
    launch(
        bound_tiles, max(pairs, len(lengths)), _BLOCK,
        keys, slots, unsorted_rows, pair_rows, begins, ends, lengths, classes, pairs, len(lengths), pairs.bit_length(),
        split_length(pairs),
    )  # fmt: skip
    # Within a class neighboring tiles follow each other. They share splats, which are then still in the caches.
    order = torch.sort(classes, descending=True, stable=True).indices.int()
    parts = split_tiles(begins, ends, order, lengths, pairs)
    return Lists(rows, first_pairs, counts, pair_rows, slots, begins, ends, order, parts)


def _rows_by_depth(
    records: Tensor, tile_counts: Tensor, places: Tensor, visible: int, view: KernelView
) -> tuple[Tensor, Tensor, Tensor]:
    """Visible rows, nearest first, the number of pairs of each, and its first pair."""
    keys, unsorted, rows, counts = (tile_counts.new_empty(visible) for _ in range(4))
    # One more, so that the sums can be written beside the first row's 0.
    first_pairs = tile_counts.new_empty(visible + 1)
    mask = -1 << (32 - view.settings.depth_bits)
    launch(
        list_visible, len(tile_counts), _BLOCK,
        records, tile_counts, places, keys, unsorted, len(tile_counts), KEY_MASK=mask,
    )  # fmt: skip
    order = torch.sort(keys, stable=True).indices
    launch(list_counts, visible, _BLOCK, tile_counts, unsorted, order, rows, counts, first_pairs, visible)
    torch.cumsum(counts, 0, dtype=torch.int32, out=first_pairs[1:])
    return rows, counts, first_pairs[:-1]


def check_pairs(pairs: int, tile_counts: Tensor) -> None:
    """Raises PairLimitError, naming the rows with most tiles, before anything of that size is allocated."""
    if pairs <= PAIR_LIMIT:
        return
    most = torch.sort(tile_counts, descending=True, stable=True)
    worst = [(int(row), int(count)) for row, count in zip(most.indices[:3], most.values[:3], strict=True)]
    raise PairLimitError.of(pairs, PAIR_LIMIT, [(row, count) for row, count in worst if count > 0])
