"""Rows of many numbers: adjacent lanes read and write them together, then each lane holds one row.

If each lane walks a row of 192 bytes by itself, every load touches 32 sectors of 32 bytes and uses 4 bytes of each.
Here
neighboring lanes take neighboring numbers of a tile [rows, columns]. The compiler passes the columns to the rows' lanes
through shared memory, one exchange per tile; the splits stay in registers.
"""

import triton
import triton.language as tl

from sparsestreet.ops.triton.language import constant, jit

# Halvings of the widest tile, of 64 columns.
LEVELS = constant(6)


@jit
def load_columns(table, row, mask, COUNT: tl.constexpr):
    """COUNT numbers of each lane's row; 0 where the mask is off."""
    width: tl.constexpr = 16 if COUNT % 16 == 0 else triton.next_power_of_2(COUNT)
    tiles = ()
    # All loads start before the first is waited for.
    for first in tl.static_range(0, COUNT, width):
        column = (first + tl.arange(0, width))[None, :]
        tiles += (tl.load(table + row[:, None] * COUNT + column, mask[:, None] & (column < COUNT), 0.0),)
    columns = ()
    for i in tl.static_range(len(tiles)):
        columns += unzipped(tiles[i], width)
    return columns


@jit
def store_columns(table, row, values, mask, COUNT: tl.constexpr):
    width: tl.constexpr = 16 if COUNT % 16 == 0 else triton.next_power_of_2(COUNT)
    for first in tl.static_range(0, COUNT, width):
        columns = ()
        for i in tl.static_range(first, first + width):
            columns += (values[i] if i < COUNT else values[0],)
        column = (first + tl.arange(0, width))[None, :]
        at = table + row[:, None] * COUNT + column
        tl.store(at, zipped(columns, width), mask[:, None] & (column < COUNT))


@jit
def unzipped(tile, WIDTH: tl.constexpr):
    """The columns of a tile [rows, WIDTH]."""
    parts = (tile,)
    # Each level has twice the parts of half the width.
    for level in tl.static_range(LEVELS):
        if WIDTH >> level > 1:
            halves = ()
            for i in tl.static_range(1 << level):
                half = tl.reshape(parts[i], (tile.shape[0], 2, WIDTH >> (level + 1)))
                left, right = tl.split(tl.permute(half, (0, 2, 1)))
                halves += (left, right)
            parts = halves
    columns = ()
    for i in tl.static_range(WIDTH):
        columns += (tl.reshape(parts[i], (tile.shape[0],)),)
    return columns


@jit
def zipped(columns, WIDTH: tl.constexpr):
    """The tile [rows, WIDTH] of these columns."""
    parts = ()
    for i in tl.static_range(WIDTH):
        parts += (tl.reshape(columns[i], (columns[i].shape[0], 1)),)
    for level in tl.static_range(LEVELS):
        if WIDTH >> level > 1:
            pairs = ()
            for i in tl.static_range(WIDTH >> (level + 1)):
                both = tl.permute(tl.join(parts[2 * i], parts[2 * i + 1]), (0, 2, 1))
                pairs += (tl.reshape(both, (columns[0].shape[0], 2 << level)),)
            parts = pairs
    return parts[0]
