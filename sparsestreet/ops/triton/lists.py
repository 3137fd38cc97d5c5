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
from sparsestreet.ops.triton import view as record
from sparsestreet.ops.triton.blend import MAX_ROWS, QUADRANT_SHIFT, WARP, half_spans, touched_quadrants
from sparsestreet.ops.triton.launch import constant, jit, launch, vectors
from sparsestreet.ops.triton.parts import LENGTH, Parts, Room, Sizes, list_by_tile, store_sizes
from sparsestreet.ops.triton.project import block_of
from sparsestreet.ops.triton.view import KernelView, tile_columns, tile_rows

_FORGOTTEN = 128
"""The largest view loses this fraction with every other view, so that the room shrinks with the scene.

A view that comes back within 28 others still fits. Too little room costs about one forward pass, too much costs
every sort."""
_seen: dict[tuple, Room] = {}


def like(rows: int, view: KernelView, device: torch.device) -> tuple:
    """What views must share to tell each other's size: scenes within a factor of two, among others."""
    return device, view.tiles, rows.bit_length(), view.settings


def predicted(place: tuple, rows: int, limit: int) -> Room | None:
    """Room for a scene of ``rows``; None: nothing is known of views ``like`` this one. At most ``limit`` pairs."""
    most = _seen.get(place)
    if most is None:
        return None
    return Room(min(_with_margin(most.rows), _up(rows)), min(_with_margin(most.pairs), limit))


def remember(place: tuple, rows: int, pairs: int) -> None:
    """What a view took: visible rows and pairs."""
    before = _seen.get(place)
    _seen[place] = Room(rows, pairs) if before is None else Room(_faded(before.rows, rows), _faded(before.pairs, pairs))


def _faded(before: int, taken: int) -> int:
    return max(taken, before - -(-before // _FORGOTTEN))


def _with_margin(count: int) -> int:
    return _up(count + count // 4)


def _up(count: int) -> int:
    """Rounded up to one of eight sizes between two powers of two, so that views like each other take the same room."""
    step = max(16, 1 << max(count.bit_length() - 4, 0))
    return -(-count // step) * step


PAIR_LIMIT = 1 << 28
"""Most (splat, tile) pairs of one rendering. A pair takes 34 bytes while sorting (torch 2.11, H100; 40 above 32,768
tiles). 12 of them are kept for the backward pass, which takes 48 more: 9 and 16 GB at the limit. Room that a view does
not fill takes the first two as well (capacity.py)."""
_SHORT_KEYS = 1 << 15
_LAST = {kind: torch.iinfo(kind).max for kind in (torch.int16, torch.int32)}
"""Keys that are sorted to the end."""
_LANES = 2
"""Lanes per splat in the listing of pairs, because most splats reach one or two rows of tiles."""
GIANT = constant(32)
"""Splats that cover at least this many tiles get a warp each."""


@dataclass(frozen=True)
class Visible:
    """Visible rows in the order of the scene, and room behind them."""

    keys: Int[Tensor, " v"]
    rows: Int[Tensor, " v"]
    counts: Int[Tensor, " v"]
    sizes: Sizes


@dataclass(frozen=True)
class Lists:
    """The tiles' lists of splats: room for v visible rows and p (splat, tile) pairs, t tiles."""

    rows: Int[Tensor, " v"]
    """Visible rows, nearest first."""
    row_ends: Int[Tensor, " v"]
    """The number after that of each row's last pair."""
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
    sizes: Sizes
    """How much of the room is used."""

    @property
    def rows_of_pairs(self) -> Int[Tensor, " p"]:
        """``pair_rows`` without the quadrants."""
        return self.pair_rows & (MAX_ROWS - 1)

    @property
    def quadrants_of_pairs(self) -> Int[Tensor, " p"]:
        """A bit for each quadrant of the tile."""
        return self.pair_rows >> QUADRANT_SHIFT & 15


@partial(jit, do_not_specialize=["row_count", "blocks", "room_rows", "room_pairs"])
def list_visible(
    records, tile_counts, sums, keys, rows, counts, sizes, row_count, blocks, room_rows, room_pairs,
    KEY_MASK: tl.constexpr, LAST: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Rows with tiles in row order, the sorted bits of their depths, and their numbers of pairs; and the sizes.

    ``sums``: the running sum over what the ``blocks`` programs of the projection counted (rows.py). Behind the last
    listed row keys are LAST, which is sorted to the end, and counts 0."""
    block, limit = tl.program_id(0), blocks - 1
    all_pairs, drawn = tl.load(sums + limit), tl.load(sums + blocks + limit)
    bad = tl.load(sums + 2 * blocks + limit) - drawn
    visible = drawn - all_pairs
    fits = (all_pairs <= room_pairs) & (visible <= room_rows)
    if block == 0:
        store_sizes(sizes, all_pairs, visible, bad, fits)
    row = block * BLOCK + tl.arange(0, BLOCK)
    count = tl.load(tile_counts + row, row < row_count, 0)
    seen = (count > 0) & fits
    before = tl.load(sums + limit + tl.minimum(block, limit)) - all_pairs
    place = before.to(tl.int32) + tl.cumsum(seen.to(tl.int32), 0) - 1
    # The bits of positive floats have the order of the floats.
    depth = tl.load(record.record_of(records, row) + record.DEPTH, seen, 1.0)
    tl.store(keys + place, depth.to(tl.int32, bitcast=True) & KEY_MASK, seen)
    tl.store(rows + place, row, seen)
    tl.store(counts + place, count, seen)
    # Lanes stand for places, of which there may be more than rows.
    unused = (row >= tl.where(fits, visible, 0)) & (row < room_rows)
    tl.store(keys + row, LAST, unused)
    tl.store(counts + row, 0, unused)


@jit
def list_splats(
    records, row, at, keys, pair_rows, given, lane, width, height, tiles_x,
    BOUNDED: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """The pairs of one splat in each line of ``row`` [splats, LANES], from ``at`` on; each lane takes a row of tiles at
    a time."""
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


@jit
def ranked(order, unsorted_rows, counts, ends, rank, room):
    """Row, number of pairs and first pair at each rank; none behind the last visible row."""
    count, end = tl.load(counts + rank, rank < room, 0), tl.load(ends + rank, rank < room, 0)
    row = tl.load(unsorted_rows + tl.load(order + rank, count > 0, 0), count > 0, 0)
    return row, count, end - count


@partial(jit, do_not_specialize=["room"])
def list_pairs(
    records, order, unsorted_rows, counts, ends, rows, keys, pair_rows, room, width, height, tiles_x,
    BOUNDED: tl.constexpr, LANES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the rows in the ``order`` of their depths. Then the tile of each pair, and its row with the quadrants it
    touches (quadrants.py).

    Pair i of a row lies in the i-th tile of its splat, counted along rows of tiles. Giants get a warp each, so that no
    other splat waits for them."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    row, _, _ = ranked(order, unsorted_rows, counts, ends, rank, room)
    tl.store(rows + rank, row, rank < room)
    lane = tl.arange(0, LANES)[None, :]
    each_row, count, first = ranked(order, unsorted_rows, counts, ends, rank[:, None] + 0 * lane, room)
    list_splats(
        records, each_row, first, keys, pair_rows, (count > 0) & (count < GIANT), lane, width, height, tiles_x,
        BOUNDED, LANES,
    )  # fmt: skip
    if tl.max(count) >= GIANT:
        warp = tl.arange(0, WARP)[None, :]
        for i in range(BLOCK):
            one = tl.program_id(0) * BLOCK + i + 0 * warp
            its_row, its_count, its_first = ranked(order, unsorted_rows, counts, ends, one, room)
            list_splats(
                records, its_row, its_first, keys, pair_rows, its_count >= GIANT, warp, width, height, tiles_x,
                BOUNDED, WARP,
            )  # fmt: skip


def list_rows(records: Tensor, tile_counts: Tensor, sums: Tensor, room: Room, view: KernelView) -> Visible:
    """Visible rows, if they and their pairs fit the room, and how many of both there are."""
    given, (keys, rows, counts) = tile_counts.shape[0], vectors(tile_counts, *(room.rows,) * 3)
    sizes = Sizes(sums.new_empty(LENGTH))
    launch(
        list_visible, max(given, room.rows, 1), block_of(view),
        records, tile_counts, sums, keys, rows, counts, sizes.on_device,
        given, sums.shape[0] // 3, room.rows, room.pairs,
        KEY_MASK=-1 << (32 - view.settings.depth_bits), LAST=_LAST[keys.dtype],
    )  # fmt: skip
    return Visible(keys, rows, counts, sizes)


def list_tiles(records: Tensor, visible: Visible, room: Room, view: KernelView) -> Lists:
    """Sort rows and pairs, which fit the room.

    The device has nothing else to do, so every host call between two of our kernels is a gap.
    """
    keys, counts = visible.keys, visible.counts
    if keys.shape[0] > room.rows:
        keys, counts = keys[: room.rows], counts[: room.rows]
    # The sorted keys are not needed: their memory takes the sorted rows.
    rows, order = torch.sort(keys, stable=True)
    counts = counts.index_select(0, order)
    ends = counts.cumsum(0, dtype=torch.int32)
    columns, lines = view.tiles
    kind = torch.int16 if columns * lines <= _SHORT_KEYS else torch.int32
    # Those of no pair are sorted to the end.
    keys, unsorted_rows = (
        counts.new_full((room.pairs,), _LAST[kind], dtype=kind),
        counts.new_empty(room.pairs),
    )
    launch(
        list_pairs, room.rows, 32 // _LANES,
        records, order, visible.rows, counts, ends, rows, keys, unsorted_rows, room.rows,
        float(view.camera.width), float(view.camera.height), columns,
        BOUNDED=view.bounded, LANES=_LANES, options={"enable_fp_fusion": False, "num_warps": 1},
    )  # fmt: skip
    keys, slots = torch.sort(keys, stable=True)
    pair_rows, *tiles = list_by_tile(keys, slots, unsorted_rows, visible.sizes, columns * lines)
    return Lists(rows, ends, counts, pair_rows, slots, *tiles, visible.sizes)


def check_pairs(pairs: int, tile_counts: Tensor) -> None:
    """Raise PairLimitError, naming the rows with most tiles, before anything of that size is allocated."""
    if pairs <= PAIR_LIMIT:
        return
    most = torch.sort(tile_counts, descending=True, stable=True)
    worst = [(int(row), int(count)) for row, count in zip(most.indices[:3], most.values[:3], strict=True)]
    raise PairLimitError.of(pairs, PAIR_LIMIT, [(row, count) for row, count in worst if count > 0])
