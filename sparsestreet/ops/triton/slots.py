"""Sums the slots of each row, which are neighbors, in a fixed order."""

from functools import partial

import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit

ROWS = 16
"""Rows of a program. Four neighboring lanes take a row's numbers, four at a time."""
OPTIONS = {"num_warps": 2}
STEP = constant(4)
"""Number of slots of a row that are loaded together."""


@partial(jit, do_not_specialize=["visible"])
def sum_slots(
    slots, rows, row_ends, tile_counts, sums, visible,
    COUNT: tl.constexpr, PADDED: tl.constexpr, SUM: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """``sums[row, :COUNT]`` of each visible row, in the type SUM; PADDED: COUNT rounded up to a power of two."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    given = rank < visible
    count = tl.load(tile_counts + rank, given, 0)
    first = (tl.load(row_ends + rank, given, 0) - count).to(tl.int64)
    field = tl.arange(0, PADDED)
    slot = slots + first[:, None] * COUNT + field[None, :]
    total = tl.zeros((BLOCK, PADDED), SUM)
    for k in range(0, tl.max(count, 0), STEP):
        wanted, values = (), ()
        for i in tl.static_range(STEP):
            wanted += (k + i < count,)
        for i in tl.static_range(STEP):
            mask = wanted[i][:, None] & (field < COUNT)[None, :]
            values += (tl.load(slot + (k + i) * COUNT, mask, 0.0),)
        for i in tl.static_range(STEP):
            total += values[i].to(SUM)
    row = tl.load(rows + rank, given, 0).to(tl.int64)
    tl.store(sums + row[:, None] * COUNT + field[None, :], total, given[:, None] & (field < COUNT)[None, :])
