"""Sums over the slots of each row, which are neighbors, in a fixed order."""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton.language import jit

ROWS = 8
"""Rows of a program."""


@partial(jit, do_not_specialize=["visible"])
def sum_slots(
    slots, rows, first_pairs, tile_counts, sums, visible,
    COUNT: tl.constexpr, PADDED: tl.constexpr, SUM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``sums[row, :COUNT]`` of each visible row, in the type SUM; PADDED: COUNT rounded up to a power of two."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = rank < visible
    first, count = tl.load(first_pairs + rank, given, 0).to(tl.int64), tl.load(tile_counts + rank, given, 0)
    field = tl.arange(0, PADDED)
    step = tl.arange(0, 8)
    total = tl.zeros((BLOCK, PADDED), SUM)
    for k in range(0, tl.max(count, 0), 8):
        slot = first[:, None] + (k + step)[None, :]
        mask = ((k + step)[None, :] < count[:, None])[:, :, None] & (field < COUNT)[None, None, :]
        values = tl.load(slots + slot[:, :, None] * COUNT + field[None, None, :], mask, 0.0)
        total += tl.sum(values.to(SUM), 1)
    row = tl.load(rows + rank, given, 0).to(tl.int64)
    tl.store(sums + row[:, None] * COUNT + field[None, :], total, given[:, None] & (field < COUNT)[None, :])
